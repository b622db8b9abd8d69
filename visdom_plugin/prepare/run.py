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
from visdom_plugin.errors import ConfigError, SceneError, list_some
from visdom_plugin.figures.contact_sheet import picture_names, write_png
from visdom_plugin.prepare import write
from visdom_plugin.prepare.photographs import Photograph, find_photographs
from visdom_plugin.prepare.placed import Placed, read_placed, turn_upright
from visdom_plugin.prepare.settings import BoardSettings, MaskSettings
from visdom_plugin.scene import NO_MASKS

log = logging.getLogger(__name__)

_MIRRORED = (2, 4, 5, 7)


@dataclass(frozen=True)
class Plan:
    """What is to be made."""

    photographs: Path
    out: Path
    size: int = 1600
    """Longest side of the pictures written, in pixels; 0 for the photographs' own."""
    masks_folder: str | None = None
    focal_35mm: float | None = None
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
    root = find_folder(plan.photographs)
    _check(plan, root)
    with opening(root):
        photographs, notes = find_photographs(root)
        asked = _asked(plan, photographs)
        earlier = write.find_earlier(plan.out, asked, plan.overwrite)
        if earlier is not None:
            return _keep(plan, earlier)
        placed = _place(photographs, plan)
        return _make(plan, root, placed, asked, [*notes, *placed.notes])


def _check(plan: Plan, root: Path) -> None:
    plan.board.check()
    if plan.size and plan.size < 64:
        raise ConfigError(
            f"--size is {plan.size}", todo="use 64 pixels or more, or 0 for the photographs' own size"
        )
    inside = plan.out.resolve() == root.resolve() or root.resolve() in plan.out.resolve().parents
    if inside:
        raise ConfigError(
            "the scene would be written into the folder of the photographs",
            where=f"--out {plan.out}",
            todo="name a folder beside it; photographs are never touched",
        )


def _asked(plan: Plan, photographs: Sequence[Photograph]) -> dict[str, Any]:
    settings = asdict(plan)
    for name in ("photographs", "out", "overwrite"):
        del settings[name]
    # As JSON gives it back: lists, not tuples.
    plain: dict[str, Any] = write.as_plain(settings)
    return {"settings": plain, "photographs": {p.name: p.sha256 for p in photographs}}


def _keep(plan: Plan, changed: list[str]) -> Prepared:
    if changed:
        notes = [f"kept as they are now, changed since they were written: {', '.join(changed[:5])}"]
    else:
        notes = ["nothing to do: the scene is there, made of these photographs with these settings"]
    return Prepared(False, write.read_record(plan.out) or {}, notes)


def _place(photographs: Sequence[Photograph], plan: Plan) -> Placed:
    from visdom_plugin.prepare.from_board import place_by_board

    return place_by_board(photographs, plan.board, plan.focal_35mm)


def _make(plan: Plan, root: Path, placed: Placed, asked: dict[str, Any], notes: list[str]) -> Prepared:
    look = plan.masks.source in ("auto", "given")
    scene = read_placed(placed, root, size=plan.size, masks=plan.masks_folder, look=look)
    views = scene.train
    order = [views.names.index(p.name) for p in placed.photographs]
    views = views.take(order)
    tags = [p.orientation if p.orientation not in _MIRRORED else 1 for p in placed.photographs]
    images = [turn(views.images[i].numpy(), tag) for i, tag in enumerate(tags)]
    ignored = [
        None if (g := views.ignored(i)) is None else turn(g.numpy(), tag) for i, tag in enumerate(tags)
    ]
    cameras = turn_upright(views.cameras, tags)
    names = picture_names([p.name for p in placed.photographs])
    given = [
        turn(views.masks[i].numpy(), tag) if views.mask_origin(i) == "given" else None
        for i, tag in enumerate(tags)
    ]
    masks, ways = _masks(plan, cameras, images, given, names)
    record: dict[str, Any] = {
        "asked": asked,
        "versions": {"visdom-plugin": version("visdom-plugin"), "opencv": _opencv()},
        "poses": {"source": placed.source, "units": placed.units, **placed.details},
        "views": {
            p.name: {"picture": f"images/{n}.png", "orientation": p.orientation, "mask": way,
                     **placed.views.get(p.name, {})}
            for p, n, way in zip(placed.photographs, names, ways, strict=True)
        },
        "left_out": placed.left_out,
        "notes": [*notes, *scene.notes[1:]],
    }  # fmt: skip
    with write.appearing_folder(plan.out) as folder:
        for i, name in enumerate(names):
            write.write_view(folder, name, images[i], masks[i], ignored[i])
        said = [_say(record["views"][p.name]) for p in placed.photographs]
        from visdom_plugin.prepare.sheet import draw_outlines

        write_png(folder / write.SHEET, draw_outlines(images, masks, names, said))
        write.finish(folder, cameras, names, record)
    return Prepared(True, record, record["notes"])


def _say(view: dict[str, Any]) -> str:
    error = view.get("reprojection_px")
    return f"mask: {view['mask']}" + (f"; {view['corners']} corners, {error:.2f} px" if error else "")


def _masks(
    plan: Plan,
    cameras: Any,
    images: Sequence[np.ndarray],
    given: Sequence[np.ndarray | None],
    names: Sequence[str],
) -> tuple[list[np.ndarray | None], list[str]]:
    """Masks and how each was made."""
    source = plan.masks.source
    if source == "none":
        return [None] * len(images), ["none"] * len(images)
    missing = [i for i, mask in enumerate(given) if mask is None]
    if source in ("auto", "given") and not missing:
        return list(given), ["given"] * len(images)
    if source == "given":
        raise SceneError(
            f"{len(missing)} of {len(images)} photographs have no mask: {list_some(names[i] for i in missing)}",
            where=plan.photographs,
            todo=NO_MASKS,
        )
    from visdom_plugin.prepare.masks.make import cut_views
    from visdom_plugin.prepare.masks.volume import board_volume, given_volume

    box = (
        given_volume(plan.masks.box) if plan.masks.box else board_volume(plan.board.size_m, plan.masks.height)
    )
    made = cut_views(cameras, images, names, box, plane=True, rounds=plan.masks.rounds)
    return [made[i] if g is None else g for i, g in enumerate(given)], [
        "grabcut" if g is None else "given" for g in given
    ]


def _opencv() -> str:
    import cv2

    return str(cv2.__version__)
