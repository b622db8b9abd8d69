"""What every layout on disk comes down to: named photographs with cameras, and how to make a scene of them.

A layout's reader returns a `Capture`; `open_capture` chooses the views of the request, asks for the cameras of
these alone, reads their pixels and brings everything to the wanted size.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules.files.paths import check_name, inside, printable, stem
from datamodules.files.undistort import Distortion
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.lazy import LaterViews
from datamodules.views.mask_files import assign_masks, find_ignored, looks_inverted
from datamodules.views.reader import ViewFiles, ViewReader, spread_out
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Scene, Views

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One photograph, not opened yet. Files are named below the capture's root, with forward slashes."""

    name: str
    """The view's name; unique but for its extension."""
    image: str
    mask: str | None = None
    """Foreground mask; None leaves it to the capture's mask folder, or to the image's alpha channel."""
    ignore: str | None = None
    """File whose black pixels are unknown (nerfstudio's meaning of a mask)."""
    excluded: str | None = None
    """File whose pixels that are not black are unknown (instant-ngp's dynamic masks); None looks for a file of
    the photograph's name in the folder `ignore`."""
    depth: str | None = None
    """16-bit PNG of monocular depth times 1000; need not exist."""


class Calibration(NamedTuple):
    """Cameras at the size they were calibrated for."""

    cameras: Cameras
    distortions: Sequence[Distortion | None]
    """One per camera; None is a pinhole."""


@dataclass(frozen=True)
class Capture:
    """A scene on disk whose calibration has been read and whose pixels have not."""

    root: Path
    layout: str
    frames: tuple[Frame, ...]
    """In the layout's order, which index files count in."""
    calibrate: Callable[[Sequence[int]], Calibration]
    """Cameras of some frames, by position; raises SceneError for what is wrong with these."""
    pools: splits.Pools
    """The layout's own split."""
    calibration_files: tuple[str, ...]
    """Files below the root that frames, cameras and split were read from; need not exist."""
    indexed: bool = False
    """Whether index files must exist."""
    photographs: str | None = None
    """Folder of the photographs, of which there may be smaller copies in `<photographs>_<F>`."""
    mask_folder: str | None = None
    """Folder of masks named after the photographs; None where there is none."""
    shrunk: float = 1.0
    """How much of the request's downscale the calibration has already (scale folders)."""
    units: str = "unknown"
    source: dict[str, Any] = field(default_factory=dict)
    """Plain data for run.json."""
    notes: tuple[str, ...] = ()
    """How the data was understood, one line each."""
    name: str | None = None
    """Of the scene; by default the root's."""


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
        "hashes": {**split.hashes, **hash_views(train)},
    }
    notes = (f"layout {capture.layout}: {split.rule}", *capture.notes, *_note_soft(loaded))
    return Scene(name, train, test, capture.units, source, notes=notes)


def hash_views(views: Views) -> dict[str, str]:
    """SHA-256 of the cameras, images, masks and depths as decoded, so that other data is told apart."""

    def digest(tensors) -> str:
        state = hashlib.sha256()
        for tensor in tensors:
            if tensor is None:
                state.update(b"none")
                continue
            state.update(json.dumps([str(tensor.dtype), list(tensor.shape)]).encode())
            state.update(memoryview(tensor.contiguous().numpy()).cast("B"))
        return state.hexdigest()

    cameras = views.cameras
    hashes = {
        "cameras": digest([cameras.intrinsics, cameras.world_from_camera, cameras.width, cameras.height]),
        "images": digest(views.images),
        "masks": digest(views.masks),
    }
    if views.ignore:
        hashes["ignore"] = digest(views.ignore)
    return hashes | ({"mono_depths": digest(views.mono_depths)} if views.mono_depths else {})


def sort_frames(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """In the order that index files count in: by name without extension."""
    return tuple(sorted(frames, key=lambda frame: stem(frame.name)))


def pinholes(
    K, world_from_camera, sizes, *, names: Sequence[str], where: Path, convention="opencv"
) -> Cameras:
    """Checked float64 cameras; faults are told by the view's name.

    Args:
        K: N rows fx, fy, cx, cy in pixels.
        world_from_camera: N matrices (3, 4) or (4, 4), nested sequences or arrays of finite size.
        sizes: N pairs width, height.

    Raises:
        SceneError: for impossible sizes, focal lengths or poses.
    """
    from datamodules.files.images import MAX_PIXELS

    K = np.asarray(K, np.float64).reshape(-1, 4)
    motion = np.asarray(world_from_camera, np.float64).reshape(len(names), -1, 4)[:, :3]
    for name, (fx, fy, cx, cy), pose, (width, height) in zip(names, K, motion, sizes, strict=True):
        fine = width > 0 and height > 0 and width * height <= MAX_PIXELS
        # Beyond these bounds float32 arithmetic on squared lengths overflows.
        fine = fine and bool(np.isfinite([fx, fy, cx, cy]).all()) and max(fx, fy, abs(cx), abs(cy)) < 1e9
        if not fine or min(fx, fy) < 1e-6:
            raise SceneError(
                f"the camera of image {printable(name)} is impossible: {width} x {height} pixels, focal lengths "
                f"{fx:g} and {fy:g}, principal point ({cx:g}, {cy:g})",
                where=where,
                cause="a damaged file, or a calibration that failed",
                todo="export the cameras again",
            )
        if not np.isfinite(pose).all() or np.abs(pose[:, 3]).max() > 1e15:
            raise SceneError(
                f"the pose of image {printable(name)} holds NaN, infinite or absurd numbers",
                where=where,
                cause="the pose estimation failed for this view, or the file is damaged",
                todo="drop the view from the data, or estimate its pose again",
            )
        off = np.abs(pose[:, :3].T @ pose[:, :3] - np.eye(3)).max() if np.abs(pose[:, :3]).max() < 2 else 9.0
        if off > 1e-3 or np.linalg.det(pose[:, :3]) < 0:
            raise SceneError(
                f"the pose of image {printable(name)} is no rotation with a translation",
                where=where,
                cause="a scaled or mirrored pose, or a damaged file",
                todo="remove scale and reflection from the matrices, or estimate the poses again",
            )
    matrices = np.zeros((len(names), 3, 3))
    matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] = K
    matrices[:, 2, 2] = 1
    sizes = torch.tensor([list(s) for s in sizes], dtype=torch.int64).reshape(-1, 2)
    return Cameras.from_matrices(
        torch.from_numpy(matrices),
        torch.from_numpy(np.ascontiguousarray(motion)),
        width=sizes[:, 0],
        height=sizes[:, 1],
        convention=convention,
    )


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


def _views(cameras: Cameras, loaded: Sequence[Any], names: Sequence[str]) -> Views:
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


def _note_soft(loaded: Sequence[Any]) -> list[str]:
    shares = [v.soft for v in loaded if v.masked]
    mean = sum(shares) / max(len(shares), 1)
    return [f"soft masks: {mean:.1%} of their pixels are neither black nor white, cut at one half"] * (
        mean > 1e-3
    )


def _warn_inverted(views: Views) -> None:
    count = sum(looks_inverted(mask) for mask in views.masks)
    if 2 * count > len(views):
        log.warning("%d of %d training masks look inverted (white must be the object)", count, len(views))
