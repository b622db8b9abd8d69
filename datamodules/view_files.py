"""The pixels of views: photograph, mask, ignored pixels and depth, checked, undistorted and brought to size."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules import images, masks
from datamodules.paths import inside, printable
from datamodules.request import Request
from datamodules.undistort import Distortion, undistort
from visdom_plugin.errors import SceneError

if TYPE_CHECKING:
    from datamodules.capture import Calibration, Capture


class ViewFiles(NamedTuple):
    """Where the pixels of one view lie below the scene's root; the fields of `capture.Frame`."""

    name: str
    image: str
    mask: str | None
    ignore: str | None
    excluded: str | None
    depth: str | None


class LoadedView(NamedTuple):
    """One view at its final size."""

    image: Tensor
    """(H, W, 3) uint8."""
    mask: Tensor
    """(H, W) bool, True on the object."""
    ignore: Tensor | None
    """(H, W) bool, True where nothing is known."""
    depth: Tensor | None
    """(H, W) float32."""
    masked: bool
    """False where the data has no mask for it; then `mask` is True everywhere."""


class _Job(NamedTuple):
    root: Path
    mask_folder: str | None
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    downscale: float
    request: Request


def read_views(
    files: Sequence[ViewFiles],
    calibration: Calibration,
    factor: float,
    downscale: float,
    capture: Capture,
    request: Request,
) -> list[LoadedView]:
    """Decodes some views in parallel.

    Raises:
        SceneError: for the first view (in the given order) that cannot be read.
    """
    import cv2

    job = _Job(capture.root, capture.mask_folder, factor, downscale, request)
    cameras = calibration.cameras
    full = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    K = cameras.intrinsics.numpy()

    def read(i: int) -> LoadedView:
        try:
            return _read_view(job, files[i], full[i], K[i], calibration.distortions[i])
        except (OSError, ValueError, cv2.error, MemoryError) as error:
            raise SceneError(
                f"view {printable(files[i].name)} cannot be read: {error}", where=job.root
            ) from error

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(read, range(len(files))))


def _read_view(
    job: _Job, file: ViewFiles, full: tuple[int, int], K: np.ndarray, distortion: Distortion | None
) -> LoadedView:
    path = inside(job.root, file.image, outside=job.request.allow_outside)
    data = images.read_file(path)
    size = images.size_of(data, path)
    _check_size(size, full, job.factor, path)
    soft, mask_path = _read_mask(job, file, size, data, path)
    masked = soft is not None
    if soft is None:
        if not job.request.allow_missing_masks:
            _no_mask(job, path)
        soft = np.ones((1, 1), np.float32)
    image = images.decode_photograph(data, path)
    ignore = _read_ignored(job, file, size)
    if distortion is not None:
        scaled = K * np.array([[size[0] / full[0]], [size[1] / full[1]], [1.0]])
        soft = _resize(soft, *size)
        image, soft, ignore = undistort(scaled, distortion, image, soft, ignore, where=path)
    target = size if job.factor > 1 else tuple(max(1, round(s / job.downscale)) for s in size)
    image = images.shrink(image, *target)
    if masked:
        mask = _resize(soft, *target) > 0.5
        masks.refuse_empty(mask, float(soft.max()), mask_path)
    else:
        mask = np.ones(target[::-1], bool)
    if ignore is not None:
        # A pixel that is unknown in part is unknown.
        ignore = torch.from_numpy(images.shrink(ignore.astype(np.float32), *target) > 0)
    return LoadedView(
        torch.from_numpy(image), torch.from_numpy(mask), ignore, _read_depth(job, file, full, target), masked
    )


def _check_size(size: tuple[int, int], full: tuple[int, int], factor: float, path: Path) -> None:
    if all(abs(s * factor - f) <= (factor if factor > 1 else 0) for s, f in zip(size, full, strict=True)):
        return
    small = f", which at 1/{factor:g} is {full[0] / factor:g} x {full[1] / factor:g}" if factor > 1 else ""
    raise SceneError(
        f"the image is {size[0]} x {size[1]} but its camera says {full[0]} x {full[1]}{small}",
        where=path,
        cause="the images were resized, cropped or rotated after the poses were estimated",
        todo="put the images there that the model was made from; smaller copies go to images_<F>",
    )


def _no_mask(job: _Job, path: Path) -> None:
    folder = job.mask_folder
    missing = folder is not None and not (job.root / folder).is_dir()
    raise SceneError(
        f"the folder {folder} is missing" if missing else "the photograph has no mask",
        where=job.root if missing else path,
        cause="and the photographs have no alpha channel to take its place" if missing else None,
        todo="put one PNG per image there, white on the object, named like the image"
        if folder is not None
        else "save the photographs as PNG with an alpha channel that is opaque on the object",
    )


def _read_mask(
    job: _Job, file: ViewFiles, size: tuple[int, int], photograph: bytes, path: Path
) -> tuple[np.ndarray | None, Path]:
    """(H, W) float32 opacity at the file's own size, and the file; None where there is no mask."""
    source, alpha, found = job.request.mask_source, None, None
    if source != "folder" and (file.mask is None or source == "alpha" or images.has_alpha(photograph)):
        if images.has_alpha(photograph):
            alpha = masks.decode_alpha(images.decode_any(photograph, path))
        if file.mask is None or source == "alpha":
            return (None if alpha is None else alpha.opacity), path
    if file.mask is None:
        return None, path
    data, mask_path = _read_other(job, file.mask, size, "mask")
    found = masks.decode(data, mask_path)
    if alpha is not None:
        masks.refuse_two(found, alpha, mask_path, path)
    return found.opacity, mask_path


def _read_other(job: _Job, relative: str, size: tuple[int, int], what: str) -> tuple[bytes, Path]:
    path = inside(job.root, relative, outside=job.request.allow_outside)
    data = images.read_file(path)
    other = images.size_of(data, path)
    if not masks.fits(other, size):
        raise SceneError(
            f"the {what} is {other[0]} x {other[1]} but its image is {size[0]} x {size[1]}",
            where=path,
            cause=f"the {what} was made of another image, or of a crop of it",
            todo=f"make the {what} from the image, at any size of the same shape",
        )
    return data, path


def _resize(soft: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average where the picture gets smaller, else the nearest value."""
    if soft.shape[0] >= height and soft.shape[1] >= width:
        return images.shrink(soft, width, height)
    return images.shrink_nearest(soft, width, height)


def _read_ignored(job: _Job, file: ViewFiles, size: tuple[int, int]) -> np.ndarray | None:
    ignore = None
    for relative, black_is_unknown in ((file.ignore, True), (file.excluded, False)):
        if relative is None:
            continue
        values = images.decode_mask(*_read_other(job, relative, size, "mask of ignored pixels"))
        unknown = values <= 0.5 if black_is_unknown else values > 0
        unknown = _resize(unknown.astype(np.float32), *size) > 0
        ignore = unknown if ignore is None else ignore | unknown
    return ignore if ignore is not None and ignore.any() else None


def _read_depth(job: _Job, file: ViewFiles, full, target) -> Tensor | None:
    if file.depth is None:
        return None
    path = inside(job.root, file.depth, outside=job.request.allow_outside)
    if not path.is_file():
        return None
    data = images.read_file(path)
    size = images.size_of(data, path)
    if abs(size[0] * full[1] - size[1] * full[0]) > max(full):
        raise SceneError(
            f"the depth map is {size[0]} x {size[1]}, another shape than its image's {full[0]} x {full[1]}",
            where=path,
            todo="make the depth map from the image, or remove it",
        )
    return torch.from_numpy(images.shrink_nearest(images.decode_depth(data, path), *target))
