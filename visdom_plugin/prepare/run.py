"""From a folder of photographs to a scene: cameras, masks, files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.files.images import turn
from datamodules.recognise import find_folder, opening
from visdom_plugin.compute.waiting import counting, phase
from visdom_plugin.errors import ConfigError
from visdom_plugin.figures.contact_sheet import picture_names, write_png
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.checks.check import check
from visdom_plugin.prepare import write
from visdom_plugin.prepare.from_board import place_by_board
from visdom_plugin.prepare.masks.choose import choose_masks
from visdom_plugin.prepare.photographs import Photograph, find_photographs
from visdom_plugin.prepare.placed import Placed, read_placed, turn_upright
from visdom_plugin.prepare.poses.by_colmap import place_by_colmap
from visdom_plugin.prepare.poses.find import holds_poses, place_by_file
from visdom_plugin.prepare.refine import fit_to_masks
from visdom_plugin.prepare.settings import BoardSettings, MaskSettings
from visdom_plugin.prepare.sheet import draw_outlines

log = logging.getLogger(__name__)

BOARD, COLMAP = Path("board"), Path("colmap")
"""In place of a file of poses: those of the printed board, or of COLMAP, which is run."""
_MIRRORED = (2, 4, 5, 7)
_GEOMETRY = ("axes", "centres", "disagreement", "order", "principal", "scale", "swapped", "view")
"""Kinds of the check's findings that speak of cameras."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be made."""

    photographs: Path
    out: Path
    size: int = 1600
    """Longest side of the pictures written, in pixels; 0 for the photographs' own."""
    masks_folder: str | None = None
    poses: Path | None = None
    """File or folder of poses, BOARD or COLMAP; None takes those beside the photographs, or the board."""
    focal_35mm: float | None = None
    refine_poses: bool = False
    """Turn the cameras until the masks agree."""
    overwrite: bool = False
    board: BoardSettings = field(default_factory=BoardSettings)
    masks: MaskSettings = field(default_factory=MaskSettings)


@dataclass(frozen=True)
class Prepared:
    """What was made."""

    made: bool
    """False where the scene was there already."""
    record: dict[str, Any]
    """The content of prepare.json."""
    notes: Sequence[str]


def prepare(plan: Plan) -> Prepared:
    """Makes the scene, or finds that it is there.

    Raises:
        SceneError: for faults of the photographs.
        ConfigError: for settings that cannot be.
    """
    root = find_folder(
        plan.photographs, todo="name the folder that the photographs are in: visdom-prepare PHOTOS"
    )
    _check(plan, root)
    with opening(root):
        photographs, notes = find_photographs(root)
        asked = _asked(plan, photographs)
        changed = write.find_earlier(plan.out, asked, plan.overwrite)
        if changed is not None:
            return _keep(plan, changed)
        return _make(plan, root, _place(photographs, plan, root), asked, notes)


def _check(plan: Plan, root: Path) -> None:
    plan.board.check()
    if plan.size < 0 or 0 < plan.size < 64:
        raise ConfigError(
            f"--size is {plan.size}", todo="use 64 pixels or more, or 0 for the photographs' own size"
        )
    if plan.masks.rounds < 0:
        raise ConfigError(f"--mask-rounds is {plan.masks.rounds}", todo="use 0 or more")
    if plan.focal_35mm is not None and not 5 < plan.focal_35mm < 2000:
        raise ConfigError(f"--focal-35mm is {plan.focal_35mm:g}", todo="a phone's main lens has about 26")
    out, source = plan.out.resolve(), root.resolve()
    if out == source or source in out.parents:
        raise ConfigError(
            "the scene would be written into the folder of the photographs",
            where=f"--out {plan.out}",
            todo="name a folder beside it; photographs are never touched",
        )


def _asked(plan: Plan, photographs: Sequence[Photograph]) -> dict[str, Any]:
    """What decides the result, as JSON gives it back."""
    settings = asdict(plan)
    for name in ("photographs", "out", "overwrite"):
        del settings[name]
    asked = {"settings": write.as_plain(settings), "photographs": {p.name: p.sha256 for p in photographs}}
    if plan.poses not in (None, BOARD, COLMAP):
        asked["poses"] = write.hash_files(plan.poses or BOARD)
    return asked


def _keep(plan: Plan, changed: list[str]) -> Prepared:
    if changed:
        notes = [f"kept as they are now, changed since they were written: {', '.join(changed[:5])}"]
    else:
        notes = ["nothing to do: the scene is there, made of these photographs with these settings"]
    return Prepared(False, write.read_record(plan.out) or {}, notes)


def _place(photographs: Sequence[Photograph], plan: Plan, root: Path) -> Placed:
    if plan.poses == COLMAP:
        return place_by_colmap(photographs)
    if plan.poses is not None and plan.poses != BOARD:
        return place_by_file(plan.poses, photographs)
    if plan.poses is None and holds_poses(root):
        log.info("%s: the poses in this folder are taken; --poses board takes those of a board", root)
        return place_by_file(root, photographs)
    return place_by_board(photographs, plan.board, plan.focal_35mm)


def _make(plan: Plan, root: Path, placed: Placed, asked: dict[str, Any], notes: list[str]) -> Prepared:
    look = plan.masks.source in ("auto", "given")
    scene = read_placed(placed, root, size=plan.size, masks=plan.masks_folder, look=look)
    views = scene.train.take([scene.train.names.index(p.name) for p in placed.photographs])
    tags = [_turn_left(p, views.images[i].shape) for i, p in enumerate(placed.photographs)]
    images = [turn(views.images[i].numpy(), tag) for i, tag in enumerate(tags)]
    ignored = [None if (g := views.ignored(i)) is None else turn(g.numpy(), t) for i, t in enumerate(tags)]
    given = [
        turn(views.masks[i].numpy(), t) if views.mask_origin(i) == "given" else None
        for i, t in enumerate(tags)
    ]
    cameras = turn_upright(views.cameras, tags)
    names = picture_names([p.name for p in placed.photographs])
    board = plan.board if placed.on_board else None
    masks, ways = choose_masks(plan.masks, cameras, images, given, names, board=board, where=plan.photographs)
    turned: list[dict[str, float]] = [{} for _ in names]
    fitted = []
    if plan.refine_poses:
        cameras, turned, note = fit_to_masks(cameras, masks, ignored, names)
        fitted = [note]
    tried = [] if placed.on_board else _try_poses(cameras, masks, names, "grabcut" in ways)
    record: dict[str, Any] = {
        "asked": asked,
        "versions": {name: version(name) for name in ("visdom-plugin", "numpy")} | {"opencv": _opencv()},
        "poses": {"source": placed.source, "units": placed.units, **placed.details},
        "views": {
            p.name: {"picture": f"images/{n}.png", "orientation": p.orientation, "mask": way}
            | placed.views.get(p.name, {})
            | moved
            for p, n, way, moved in zip(placed.photographs, names, ways, turned, strict=True)
        },
        "left_out": placed.left_out,
        "notes": [*notes, *placed.notes, *scene.notes[1:], *fitted, *tried],
    }
    said = [_say(record["views"][p.name]) for p in placed.photographs]
    with write.appearing_folder(plan.out) as folder, counting("writing the scene", len(names)) as count:
        for i, name in enumerate(names):
            write.write_view(folder, name, images[i], masks[i], ignored[i])
            count(name)
        write_png(folder / write.SHEET, draw_outlines(images, masks, names, said))
        write.finish(folder, cameras, names, record)
    return Prepared(True, record, record["notes"])


def _turn_left(photograph: Photograph, shape: Sequence[int]) -> int:
    """The tag that is left to turn a picture by: the reader turns it where its camera is for the upright one."""
    tag, (width, height) = photograph.orientation, photograph.size
    upright = tag >= 5 and width != height and (shape[1] > shape[0]) != (width > height)
    return 1 if upright or tag in _MIRRORED else tag


@phase("trying the poses on the silhouettes")
def _try_poses(
    cameras: Cameras, masks: Sequence[np.ndarray | None], names: Sequence[str], guessed: bool
) -> list[str]:
    """What the silhouettes say of imported poses, one line each.

    Args:
        guessed: whether colours alone made some of the masks, which are then as doubtful as the poses.
    """
    known = [(i, mask) for i, mask in enumerate(masks) if mask is not None]
    if len(known) < 2:
        return ["the poses could not be tried on silhouettes: there are no masks"]
    index = [i for i, _ in known]
    found = check(cameras[index], [mask for _, mask in known], names=[names[i] for i in index])
    doubts = [f"{f.sure}: {f.what}" for f in found.findings if f.kind in _GEOMETRY]
    fit = "" if found.fit is None else f" (they miss each other by {found.fit.score:.2f} px in the mean)"
    who = "masks and poses do not fit each other" if guessed else "the silhouettes doubt the poses"
    return [f"{who}: {d}" for d in doubts] or [f"the silhouettes fit the poses{fit}"]


def _say(view: dict[str, Any]) -> str:
    error = view.get("reprojection_px")
    return f"mask: {view['mask']}" + (f"; {view['corners']} corners, {error:.2f} px" if error else "")


def _opencv() -> str:
    import cv2

    return str(cv2.__version__)
