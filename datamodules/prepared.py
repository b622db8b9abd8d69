"""GaussianObject's prepared scenes: photographs, masks and a COLMAP model of undistorted cameras.

images/ or images_<F>/   photographs, F times smaller in the latter
masks/<stem>.png         foreground masks at either size
sparse/0/                COLMAP model, text or binary
sparse_<N>.txt           the N training views, sparse_test.txt the test views: zero-based positions in the
                         list of all registered images, sorted by name without extension
zoe_depth/<stem>.png     optional monocular depth of the training views (16 bit, times 1000)
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules import colmap, images, splits
from datamodules.paths import check_name, inside
from visdom_plugin.cameras import Cameras
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.scene import Scene, Views

log = logging.getLogger(__name__)

_SHOWN = 5


class _View(NamedTuple):
    image: Tensor
    mask: Tensor
    depth: Tensor | None


@dataclass(frozen=True)
class _Folder:
    """Where the pixels of one request lie."""

    root: Path
    images: Path
    factor: float
    """How much smaller the files are than the cameras say; 1 for `images/`."""
    downscale: float


def matches(root: Path) -> bool:
    """Whether the folder has this layout, complete or not."""
    return (root / "sparse").is_dir() or any(root.glob("sparse_*.txt"))


def load_prepared(root: Path, *, views: int | None, downscale: float, test: bool = True) -> Scene:
    """Reads a prepared scene.

    With `downscale` F the files of `images_<F>/` are taken as they are where that folder exists; otherwise
    those of `images/` are averaged over areas to round(size / F). Masks are averaged in the same way and cut
    at one half, so a part thinner than half a pixel of the smaller image is lost. Intrinsics follow each
    axis's exact ratio. Only the wanted views are decoded, on all cores.

    Args:
        root: the scene's folder.
        views: N of the index file sparse_<N>.txt; None takes the smallest one there is.
        downscale: >= 1.
        test: False leaves the test views out (they come back empty) and does not look at their files.

    Raises:
        SceneError: for every fault of the data.
        ConfigError: for a downscale below 1.
    """
    if not (math.isfinite(downscale) and downscale >= 1):
        raise ConfigError(f"downscale is {downscale:g}; it must be 1 or more", where="--downscale")
    for name in colmap.FILES:
        inside(root, f"sparse/0/{name}")
    model = colmap.read_model(root / "sparse" / "0")
    registered = _sorted_images(model)
    train_index, test_index, index_files = splits.read_splits(root, views, len(registered), test=test)
    train, tested = [registered[i] for i in train_index], [registered[i] for i in test_index]
    cameras = colmap.cameras_of(model, train + tested)
    folder = _image_folder(root, downscale)
    _check_masks(root, registered, train + tested)
    loaded = _read_views(folder, train + tested, cameras)
    sizes = torch.tensor([[v.image.shape[1], v.image.shape[0]] for v in loaded]).reshape(-1, 2)
    cameras = cameras.resized(sizes[:, 0], sizes[:, 1])
    n = len(train)
    train_views = _views(cameras[:n], loaded[:n], train)
    _warn_inverted(train_views)
    source = {
        "root": root.resolve().name,
        "layout": "prepared",
        "views": n,
        "downscale": float(downscale),
        "images": folder.images.name,
        "train": [image.name for image in train],
        "test": [image.name for image in tested],
        "hashes": {**index_files, **hash_views(train_views)},
    }
    return Scene(root.resolve().name, train_views, _views(cameras[n:], loaded[n:], tested), source=source)


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
    return hashes | ({"mono_depths": digest(views.mono_depths)} if views.mono_depths else {})


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))


def _sorted_images(model: colmap.Model) -> list[colmap.Registered]:
    for image in model.images:
        check_name(image.name, model.folder)
    ordered = sorted(model.images, key=lambda image: _stem(image.name))
    for one, two in pairwise(ordered):
        if _stem(one.name) == _stem(two.name):
            raise SceneError(
                f"two registered images share the name {_stem(one.name)}: {one.name} and {two.name}",
                where=model.folder,
                cause="positions in the index files and masks are found by this name",
                todo="rename one of them",
            )
    return ordered


def _image_folder(root: Path, downscale: float) -> _Folder:
    smaller = f"images_{downscale:g}"
    if downscale > 1 and inside(root, smaller).is_dir():
        return _Folder(root, root / smaller, downscale, downscale)
    if inside(root, "images").is_dir():
        return _Folder(root, root / "images", 1.0, downscale)
    others = sorted(p.name for p in root.glob("images_*") if p.is_dir())
    raise SceneError(
        "the folder images is missing" + (f"; there is {', '.join(others)}" if others else ""),
        where=root,
        todo=f"pass --downscale {others[0].removeprefix('images_')}"
        if others
        else "put the photographs there",
    )


def _check_masks(root: Path, registered: Sequence[colmap.Registered], wanted) -> None:
    folder = inside(root, "masks")
    if not folder.is_dir():
        raise SceneError(
            "the folder masks is missing",
            where=root,
            todo="put one PNG per image there, white on the object, named like the image",
        )
    there = {_stem(path.relative_to(folder).as_posix()) for path in folder.rglob("*.png")}
    named = {_stem(image.name) for image in registered}
    missing = [_stem(image.name) for image in wanted if _stem(image.name) not in there]
    extra = sorted(there - named)
    without = sorted(named - there)
    if missing or _shifted(without, extra):
        missing = missing or without
        hint = f"there are masks that no image has: {_some(extra)}" if extra else None
        raise SceneError(
            f"{len(missing)} of the images have no mask: {_some(missing)}",
            where=folder,
            cause=f"masks named otherwise, or shifted by one; {hint}" if hint else None,
            todo="name each mask like its image, with the ending .png",
        )
    if extra:
        log.info(
            "%s: %d masks belong to no registered image and are ignored: %s", folder, len(extra), _some(extra)
        )


def _shifted(without: list[str], extra: list[str]) -> bool:
    """Names that are the same numbers moved on, such as images 000..035 and masks 001..036."""

    def numbers(stems):
        digits = ["".join(c for c in stem if c.isdigit()) for stem in stems]
        return [int(d) for d in digits if d]

    a, b = numbers(without), numbers(extra)
    return bool(a) and len(a) == len(b) == len(extra) == len(without)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f", ... ({len(names)} in all)" if len(names) > _SHOWN else "")


def _read_views(folder: _Folder, wanted: Sequence[colmap.Registered], cameras: Cameras) -> list[_View]:
    import cv2

    depths = inside(folder.root, "zoe_depth")
    full = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))

    def read(i: int) -> _View:
        try:
            return _read_view(folder, wanted[i].name, full[i], depths if depths.is_dir() else None)
        except (OSError, ValueError, cv2.error, MemoryError) as error:
            raise SceneError(f"view {wanted[i].name} cannot be read: {error}", where=folder.images) from error

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(read, range(len(wanted))))


def _read_view(folder: _Folder, name: str, full: tuple[int, int], depths: Path | None) -> _View:
    path = inside(folder.root, f"{folder.images.name}/{name}")
    data = images.read_file(path)
    size = images.size_of(data, path)
    factor = folder.factor
    if any(abs(s * factor - f) > (factor if factor > 1 else 0) for s, f in zip(size, full, strict=True)):
        raise SceneError(
            f"the image is {size[0]} x {size[1]} but its camera says {full[0]} x {full[1]}"
            + (
                f", which at 1/{factor:g} is {full[0] / factor:g} x {full[1] / factor:g}"
                if factor > 1
                else ""
            ),
            where=path,
            cause="the images were resized, cropped or rotated after the poses were estimated",
            todo="put the images there that the model was made from; smaller copies go to images_<F>",
        )
    target = size if factor > 1 else tuple(max(1, round(s / folder.downscale)) for s in size)
    image = images.shrink(images.decode_photograph(data, path), *target)
    mask = _read_mask(folder, name, full, size, target)
    depth = None
    if depths is not None and (path := inside(folder.root, f"zoe_depth/{_stem(name)}.png")).is_file():
        data = images.read_file(path)
        _check_shape(images.size_of(data, path), full, path, "depth map")
        depth = torch.from_numpy(images.shrink_nearest(images.decode_depth(data, path), *target))
    return _View(torch.from_numpy(image), torch.from_numpy(mask), depth)


def _read_mask(folder: _Folder, name: str, full, size, target) -> np.ndarray:
    path = inside(folder.root, f"masks/{_stem(name)}.png")
    data = images.read_file(path)
    mask_size = images.size_of(data, path)
    if mask_size not in (full, size):
        raise SceneError(
            f"the mask is {mask_size[0]} x {mask_size[1]} but its image is {size[0]} x {size[1]}",
            where=path,
            cause="the mask was made at another resolution or belongs to another image",
            todo="make the mask at the size of the image",
        )
    soft = images.decode_mask(data, path)
    mask = images.shrink(soft, *target) > 0.5
    if not mask.any():
        peak = float(soft.max())
        if 0 < peak < 0.02:
            cause, todo = "the mask holds 0 and 1 where 0 and 255 are meant", "multiply the masks by 255"
        elif peak > 0.5:
            cause, todo = "the object is thinner than a pixel at this size", "use a smaller --downscale"
        else:
            cause, todo = "the segmentation found nothing in this view", "mask the object, or drop the view"
        raise SceneError(
            "the mask is empty: no pixel of it is foreground", where=path, cause=cause, todo=todo
        )
    return mask


def _check_shape(size: tuple[int, int], full: tuple[int, int], path: Path, what: str) -> None:
    if abs(size[0] * full[1] - size[1] * full[0]) > max(full):
        raise SceneError(
            f"the {what} is {size[0]} x {size[1]}, another shape than its image's {full[0]} x {full[1]}",
            where=path,
            todo=f"make the {what} from the image, or remove it",
        )


def _views(cameras: Cameras, loaded: Sequence[_View], registered) -> Views:
    depths = tuple(v.depth for v in loaded)
    return Views(
        cameras=cameras,
        images=tuple(v.image for v in loaded),
        masks=tuple(v.mask for v in loaded),
        names=tuple(image.name for image in registered),
        mono_depths=depths if any(d is not None for d in depths) else (),
    )


def _warn_inverted(views: Views) -> None:
    """Objects sit inside their photographs: masks that hold the border but not the middle look inverted."""

    def looks_inverted(mask: Tensor) -> bool:
        border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean()
        return bool(border > 0.8 and border > mask.float().mean())

    count = sum(looks_inverted(mask) for mask in views.masks)
    if 2 * count > len(views):
        log.warning("%d of %d training masks look inverted (white must be the object)", count, len(views))
