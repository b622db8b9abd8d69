"""The pixels of views: photograph, mask, ignored pixels and depth, checked, undistorted and brought to size."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules.files import images, masks
from datamodules.files.paths import inside, printable
from datamodules.files.undistort import Distortion, undistort
from datamodules.request import Request
from visdom_plugin.errors import SceneError

if TYPE_CHECKING:
    from datamodules.open_scene import Calibration, Capture


_VERSION = 1
"""Raised when other pixels are made of the same files."""


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
    soft: float = 0.0
    """Share of the mask's pixels that are neither black nor white."""


class _Job(NamedTuple):
    root: Path
    mask_folder: str | None
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    downscale: float
    request: Request


class InspectedView(NamedTuple):
    """What is known of a view whose photograph has not been decoded."""

    size: tuple[int, int]
    """Width and height it will have."""
    masked: bool
    ignoring: bool
    """Whether it may have ignored pixels."""
    deep: bool
    """Whether it has a depth map."""
    fingerprint: str
    """SHA-256 of its files and of all that decides what is made of them."""


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


def spread_out(function: Callable[[int], Any], positions: Sequence[int]) -> list[Any]:
    """`function` of each position, on all cores; the first (in the given order) error is raised."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, positions))


def _open_photograph(job: _Job, file: ViewFiles, full: tuple[int, int]):
    """Path, bytes, size and wanted size."""
    path = inside(job.root, file.image, outside=job.request.allow_outside)
    data = images.read_file(path)
    size = images.size_of(data, path)
    _check_size(size, full, job.factor, path)
    target = size if job.factor > 1 else tuple(max(1, round(s / job.downscale)) for s in size)
    return path, data, size, target


def _inspect_view(job: _Job, file: ViewFiles, full: tuple[int, int], plan: str) -> InspectedView:
    path, data, size, target = _open_photograph(job, file, full)
    state = hashlib.sha256(f"{_VERSION} {plan} {job.request.mask_source}".encode())
    state.update(data)
    outside = job.request.allow_outside
    for relative in (file.mask, file.ignore, file.excluded, file.depth):
        if relative is not None and (other := inside(job.root, relative, outside=outside)).is_file():
            state.update(hashlib.sha256(images.read_file(other)).digest())
    masked = images.has_alpha(data) and job.request.mask_source != "folder"
    if file.mask is not None or (masked and job.request.allow_missing_masks):
        soft, mask_path = _read_mask(job, file, size, data, path)
        masked = soft is not None
        if masked:
            masks.refuse_empty(_resize(soft, *target) > 0.5, float(soft.max()), mask_path)
    if not masked and not job.request.allow_missing_masks:
        _no_mask(job, file, path)
    for relative in (file.ignore, file.excluded):
        if relative is not None:
            _read_other(job, relative, size, "mask of ignored pixels")
    depth = None if file.depth is None else inside(job.root, file.depth, outside=outside)
    ignoring = file.ignore is not None or file.excluded is not None
    return InspectedView(target, masked, ignoring, depth is not None and depth.is_file(), state.hexdigest())


def _read_view(
    job: _Job, file: ViewFiles, full: tuple[int, int], K: np.ndarray, distortion: Distortion | None
) -> LoadedView:
    path, data, size, target = _open_photograph(job, file, full)
    soft, mask_path = _read_mask(job, file, size, data, path)
    masked = soft is not None
    if soft is None:
        if not job.request.allow_missing_masks:
            _no_mask(job, file, path)
        soft = np.ones((1, 1), np.float32)
    image = images.decode_photograph(data, path)
    ignore = _read_ignored(job, file, size)
    if distortion is not None:
        scaled = K * np.array([[size[0] / full[0]], [size[1] / full[1]], [1.0]])
        soft = _resize(soft, *size)
        image, soft, ignore = undistort(scaled, distortion, image, soft, ignore, where=path)
    if masked:
        mask = _resize(soft, *target) > 0.5
        masks.refuse_empty(mask, float(soft.max()), mask_path)
    else:
        mask = np.ones(target[::-1], bool)
    # Colours are stored for what is there: where nothing is, they are anything.
    cut_out = masked and mask_path == path
    image = images.shrink_cut_out(image, soft, *target) if cut_out else images.shrink(image, *target)
    if ignore is not None:
        # A pixel that is unknown in part is unknown.
        ignore = torch.from_numpy(images.shrink(ignore.astype(np.float32), *target) > 0)
    return LoadedView(
        torch.from_numpy(image),
        torch.from_numpy(mask),
        ignore,
        _read_depth(job, file, full, target),
        masked,
        masks.soft_share(soft) if masked else 0.0,
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
