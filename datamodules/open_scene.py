"""Scenes from captures: the views of a request chosen, read and brought to size.

A layout's reader returns a `Capture`; `open_capture` chooses the views of the request, asks for the cameras of
these alone, reads their pixels and brings everything to the wanted size.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import torch
from torch import Tensor

from datamodules.capture import Capture, LoadedView, ViewFiles
from datamodules.files.colmap_points import read_points
from datamodules.files.paths import check_name, inside, printable, stem
from datamodules.hashing import hash_parts
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.lazy import LaterViews
from datamodules.views.mask_files import assign_masks, find_ignored, looks_inverted
from datamodules.views.reader import ViewReader, spread_out
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Scene, Views

log = logging.getLogger(__name__)


class Chosen(NamedTuple):
    """The views of a request, and where their pixels lie."""

    split: splits.Split
    folder: str | None
    """Of the photographs."""
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    files: list[ViewFiles]
    """Of the training views, then of the test views."""


def choose_files(capture: Capture, request: Request) -> Chosen:
    """The views of a request and their files, none of which is opened.

    Raises:
        SceneError: for views, folders or masks that are not there.
        ConfigError: for a list given by hand that does not fit the data.
    """
    if not capture.frames:
        raise SceneError(
            "the scene has no photographs", where=capture.root, cause="a scene that was copied only in part"
        )
    _check_names(capture, request)
    names = [frame.name for frame in capture.frames]
    split = splits.choose(capture.root, names, request, capture.pools, indexed=capture.indexed)
    wanted = [*split.train, *split.test]
    folder, factor = _photographs(capture, request.downscale / capture.shrunk, request)
    masks = assign_masks(capture, wanted, request)
    ignored = find_ignored(capture, wanted, request)
    files = [_files(capture, i, folder, masks[i], ignored.get(i)) for i in wanted]
    return Chosen(split, folder, factor, files)


def open_capture(capture: Capture, request: Request) -> Scene:
    """The scene of a request.

    With a downscale F the files of `<photographs>_<F>` are taken as they are where that folder exists;
    otherwise photographs are averaged over areas to round(size / F). Masks are averaged in the same way and
    cut at one half. Intrinsics follow each axis's exact ratio. Training views are decoded on all cores; the files
    of test views are checked, and their photographs decoded when they are first looked at.

    Raises:
        SceneError: for every fault of the data.
        ConfigError: for a list given by hand that does not fit the data.
    """
    split, folder, factor, files = choose_files(capture, request)
    names = [frame.name for frame in capture.frames]
    calibration = capture.calibrate([*split.train, *split.test])
    reader = ViewReader(files, calibration, factor, request.downscale / capture.shrunk, capture, request)
    n = len(split.train)
    loaded = spread_out(reader.read, range(n))
    later = LaterViews(lambda i: reader.read(n + i), spread_out(reader.inspect, range(n, len(files))))
    sizes = [(v.image.shape[1], v.image.shape[0]) for v in loaded] + [v.size for v in later.inspected]
    cameras = calibration.cameras.resized(*torch.tensor(sizes).reshape(-1, 2).unbind(1))
    train = _views(cameras[:n], loaded, [names[i] for i in split.train])
    bent = any(d is not None for d in calibration.distortions[n:])
    test = _later_views(cameras[n:], later, [names[i] for i in split.test], bent=bent)
    _warn_inverted(train)
    name = printable(capture.name or capture.root.resolve().name)
    source = {
        "root": name,
        "layout": capture.layout,
        "views": n,
        "downscale": float(request.downscale),
        "images": folder,
        "split": split.rule,
        "train": list(train.names),
        "test": list(test.names),
        **capture.source,
        "hashes": {**split.hashes, **hash_parts(train)},
    }
    notes = (
        f"layout {capture.layout}: {split.rule}",
        *capture.notes,
        *_note_soft(loaded),
        *_note_remarks(loaded),
    )
    cloud = None
    if capture.points_file is not None:
        cloud = partial(_read_points, capture.root, capture.points_file, request.allow_outside)
    return Scene(name, train, test, capture.units, source, notes=notes, read_points=cloud)


def _read_points(root: Path, file: str, outside: bool) -> tuple[Tensor, Tensor] | None:
    xyz, rgb = read_points(root, file, outside=outside)
    return (torch.from_numpy(xyz), torch.from_numpy(rgb).float() / 255) if len(xyz) else None


def _check_names(capture: Capture, request: Request) -> None:
    for frame in capture.frames:
        check_name(frame.name, capture.root, outside=request.allow_outside)
    ordered = sorted((stem(frame.name), frame.name) for frame in capture.frames)
    for (one, first), (two, second) in pairwise(ordered):
        if one == two:
            raise SceneError(
                f"two registered images share the name {one}: {first} and {second}",
                where=capture.root,
                cause="positions in the index files and masks are found by this name",
                todo="rename one of them",
            )


def _photographs(capture: Capture, downscale: float, request: Request) -> tuple[str | None, float]:
    """The folder to read, and how much smaller its files are than the cameras say."""
    base, root, outside = capture.photographs, capture.root, request.allow_outside
    if base is None:
        return None, 1.0
    smaller = f"{base}_{downscale:g}"
    if downscale > 1 and inside(root, smaller, outside=outside).is_dir():
        return smaller, downscale
    if inside(root, base, outside=outside).is_dir():
        return base, 1.0
    others = sorted(p.name for p in root.glob(f"{PurePosixPath(base).name}_*") if p.is_dir())
    raise SceneError(
        f"the folder {base} is missing"
        + (f"; there is {', '.join(map(printable, others))}" if others else ""),
        where=root,
        todo=f"pass --downscale {printable(others[0].rpartition('_')[2])}"
        if others
        else "put the photographs there",
    )


def _files(
    capture: Capture, index: int, folder: str | None, mask: str | None, ignored: str | None
) -> ViewFiles:
    frame = capture.frames[index]
    image = frame.image
    if folder is not None and folder != capture.photographs:
        below = image.removeprefix(f"{capture.photographs}/")
        image = f"{folder}/{below}" if below != image else image
    excluded = frame.excluded or ignored
    return ViewFiles(frame.name, image, mask, frame.ignore, excluded, frame.depth)


def _views(cameras: Cameras, loaded: Sequence[LoadedView], names: Sequence[str]) -> Views:
    def optional(values: list[Tensor | None]) -> tuple[Tensor | None, ...]:
        return tuple(values) if any(v is not None for v in values) else ()

    return Views(
        cameras=cameras,
        images=tuple(v.image for v in loaded),
        masks=tuple(v.mask for v in loaded),
        names=tuple(names),
        mono_depths=optional([v.depth for v in loaded]),
        ignore=optional([v.ignore for v in loaded]),
        mask_origins=()
        if all(v.masked for v in loaded)
        else tuple("given" if v.masked else "missing" for v in loaded),
    )


def _later_views(cameras: Cameras, later: LaterViews, names: Sequence[str], *, bent: bool) -> Views:
    seen = later.inspected
    return Views(
        cameras=cameras,
        images=later.field("image"),
        masks=later.field("mask"),
        names=tuple(names),
        mono_depths=later.field("depth") if any(v.deep for v in seen) else (),
        ignore=later.field("ignore") if bent or any(v.ignoring for v in seen) else (),
        mask_origins=()
        if all(v.masked for v in seen)
        else tuple("given" if v.masked else "missing" for v in seen),
    )


def _note_soft(loaded: Sequence[LoadedView]) -> list[str]:
    shares = [v.soft for v in loaded if v.masked]
    mean = sum(shares) / max(len(shares), 1)
    return [f"soft masks: {mean:.1%} of their pixels are neither black nor white, cut at one half"] * (
        mean > 1e-3
    )


def _note_remarks(loaded: Sequence[LoadedView]) -> list[str]:
    counts = Counter(remark for view in loaded for remark in view.remarks)
    notes = [f"{count} of {len(loaded)} training views: {remark}" for remark, count in counts.items()]
    for note in notes:
        log.warning("%s", note)
    return notes


def _warn_inverted(views: Views) -> None:
    count = sum(looks_inverted(mask) for mask in views.masks)
    if 2 * count > len(views):
        log.warning("%d of %d training masks look inverted (white must be the object)", count, len(views))
