"""The pixels of views: photograph, mask, ignored pixels and depth, checked, undistorted and brought to size."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from datamodules.capture import Calibration, Capture, InspectedView, LoadedView, ViewFiles
from datamodules.files import images, masks
from datamodules.files.paths import inside, printable
from datamodules.files.undistort import Distortion, undistort
from datamodules.request import Request
from visdom_plugin.errors import SceneError

_T = TypeVar("_T")
_VERSION = 1
"""Raised when other pixels are made of the same files."""


class _Job(NamedTuple):
    root: Path
    mask_folder: str | None
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    downscale: float
    request: Request


class ViewReader:
    """Reads views of one request, each by its position, in any thread."""

    def __init__(
        self,
        files: Sequence[ViewFiles],
        calibration: Calibration,
        factor: float,
        downscale: float,
        capture: Capture,
        request: Request,
    ):
        self._job = _Job(capture.root, capture.mask_folder, factor, downscale, request)
        self._files, self._distortions = files, calibration.distortions
        cameras = calibration.cameras
        self._full = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
        self._K = cameras.intrinsics.numpy()

    def read(self, i: int) -> LoadedView:
        """Decodes one view.

        Raises:
            SceneError: for everything wrong with its files.
        """
        with self._named(i):
            return _read_view(self._job, self._files[i], self._full[i], self._K[i], self._distortions[i])

    def inspect(self, i: int) -> InspectedView:
        """Checks one view's files to their last byte, and that its mask is not empty, without decoding its
        photograph.

        Raises:
            SceneError: for everything wrong with them that shows.
        """
        with self._named(i):
            plan = repr((self._full[i], self._K[i].tolist(), self._distortions[i], *self._job[2:4]))
            return _inspect_view(self._job, self._files[i], self._full[i], plan)

    @contextmanager
    def _named(self, i: int) -> Iterator[None]:
        import cv2

        try:
            yield
        except (OSError, ValueError, cv2.error, MemoryError) as error:
            raise SceneError(
                f"view {printable(self._files[i].name)} cannot be read: {error}", where=self._job.root
            ) from error


def spread_out(function: Callable[[int], _T], positions: Sequence[int]) -> list[_T]:
    """`function` of each position, on all cores; the first (in the given order) error is raised."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, positions))


class _Photograph(NamedTuple):
    path: Path
    data: bytes
    size: tuple[int, int]
    alpha: bool
    """Whether it promises transparency."""
    target: tuple[int, int]
    """Width and height that are wanted."""


def _open_photograph(job: _Job, file: ViewFiles, full: tuple[int, int]) -> _Photograph:
    path = inside(job.root, file.image, outside=job.request.allow_outside)
    data = images.read_file(path)
    size, alpha = images.read_header(data, path)
    _check_size(size, full, job.factor, path)
    width, height = (s if job.factor > 1 else max(1, round(s / job.downscale)) for s in size)
    return _Photograph(path, data, size, alpha, (width, height))


def _inspect_view(job: _Job, file: ViewFiles, full: tuple[int, int], plan: str) -> InspectedView:
    photo = _open_photograph(job, file, full)
    state = hashlib.sha256(f"{_VERSION} {plan} {job.request.mask_source}".encode())
    state.update(photo.data)
    outside = job.request.allow_outside
    for relative in (file.mask, file.ignore, file.excluded, file.depth):
        if relative is not None and (other := inside(job.root, relative, outside=outside)).is_file():
            state.update(hashlib.sha256(images.read_file(other)).digest())
    masked = photo.alpha and job.request.mask_source != "folder"
    if file.mask is not None or (masked and job.request.allow_missing_masks):
        soft, mask_path = _read_mask(job, file, photo)
        masked = soft is not None
        if soft is not None:
            masks.refuse_empty(_resize(soft, *photo.target) > 0.5, float(soft.max()), mask_path)
    if not masked and not job.request.allow_missing_masks:
        _no_mask(job, file, photo.path)
    for relative in (file.ignore, file.excluded):
        if relative is not None:
            _read_other(job, relative, photo.size, "mask of ignored pixels")
    depth = None if file.depth is None else inside(job.root, file.depth, outside=outside)
    return InspectedView(
        size=photo.target,
        masked=masked,
        ignoring=file.ignore is not None or file.excluded is not None,
        deep=depth is not None and depth.is_file(),
        fingerprint=state.hexdigest(),
    )


def _read_view(
    job: _Job, file: ViewFiles, full: tuple[int, int], K: np.ndarray, distortion: Distortion | None
) -> LoadedView:
    photo = _open_photograph(job, file, full)
    opacity, mask_path = _read_mask(job, file, photo)
    masked = opacity is not None
    if not masked and not job.request.allow_missing_masks:
        _no_mask(job, file, photo.path)
    soft = np.ones((1, 1), np.float32) if opacity is None else opacity
    image = images.decode_photograph(photo.data, photo.path)
    unknown = _read_ignored(job, file, photo.size)
    if distortion is not None:
        scaled = K * np.array([[photo.size[0] / full[0]], [photo.size[1] / full[1]], [1.0]])
        flat = undistort(scaled, distortion, image, _resize(soft, *photo.size), unknown, where=photo.path)
        image, unknown = flat.image, flat.ignore
        soft = soft if flat.mask is None else flat.mask
    width, height = photo.target
    if masked:
        mask = _resize(soft, width, height) > 0.5
        masks.refuse_empty(mask, float(soft.max()), mask_path)
    else:
        mask = np.ones((height, width), bool)
    # Colours are stored for what is there: where nothing is, they are anything.
    if masked and mask_path == photo.path:
        image = images.shrink_cut_out(image, soft, width, height)
    else:
        image = images.shrink(image, width, height)
    if unknown is not None:
        # A pixel that is unknown in part is unknown.
        unknown = images.shrink(unknown.astype(np.float32), width, height) > 0
    return LoadedView(
        image=torch.from_numpy(image),
        mask=torch.from_numpy(mask),
        ignore=None if unknown is None else torch.from_numpy(unknown),
        depth=_read_depth(job, file, full, photo.target),
        masked=masked,
        soft=masks.soft_share(soft) if masked else 0.0,
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


def _no_mask(job: _Job, file: ViewFiles, path: Path) -> None:
    if file.ignore is not None:
        raise SceneError(
            f"the photograph has no foreground mask: {file.ignore} says which pixels to ignore",
            where=path,
            cause="mask_path has nerfstudio's meaning here",
            todo="pass --mask-path foreground if these files are white on the object",
        )
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


def _read_mask(job: _Job, file: ViewFiles, photo: _Photograph) -> tuple[np.ndarray | None, Path]:
    """(H, W) float32 opacity at the file's own size, and the file; None where there is no mask."""
    source, alpha = job.request.mask_source, None
    if photo.alpha and source != "folder":
        alpha = masks.decode_alpha(images.decode_any(photo.data, photo.path))
    if source == "alpha" or (file.mask is None and source != "folder"):
        return (None if alpha is None else alpha.opacity), photo.path
    if file.mask is None:
        return None, photo.path
    data, mask_path = _read_other(job, file.mask, photo.size, "mask")
    found = masks.decode_mask(data, mask_path)
    if alpha is not None:
        masks.refuse_two(found, alpha, mask_path, photo.path)
    return found.opacity, mask_path


def _read_other(job: _Job, relative: str, size: tuple[int, int], what: str) -> tuple[bytes, Path]:
    path = inside(job.root, relative, outside=job.request.allow_outside)
    data = images.read_file(path)
    other = images.read_header(data, path).size
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
        values = masks.decode_mask(*_read_other(job, relative, size, "mask of ignored pixels")).opacity
        unknown = values <= 0.5 if black_is_unknown else values > 0
        unknown = _resize(unknown.astype(np.float32), *size) > 0
        ignore = unknown if ignore is None else ignore | unknown
    return ignore if ignore is not None and ignore.any() else None


def _read_depth(job: _Job, file: ViewFiles, full: tuple[int, int], target: tuple[int, int]) -> Tensor | None:
    if file.depth is None:
        return None
    path = inside(job.root, file.depth, outside=job.request.allow_outside)
    if not path.is_file():
        return None
    data = images.read_file(path)
    size = images.read_header(data, path).size
    if abs(size[0] * full[1] - size[1] * full[0]) > max(full):
        raise SceneError(
            f"the depth map is {size[0]} x {size[1]}, another shape than its image's {full[0]} x {full[1]}",
            where=path,
            todo="make the depth map from the image, or remove it",
        )
    return torch.from_numpy(images.shrink_nearest(images.decode_depth(data, path), *target))
