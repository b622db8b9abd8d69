"""The pixels of views: photograph, mask, ignored pixels and depth, checked, undistorted and brought to size."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
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
from datamodules.views import orientation
from visdom_plugin.errors import SceneError

_T = TypeVar("_T")
_LOOKED_AT = 6
"""Views whose pixels decide whether masks are turned."""
_VERSION = 1
"""Raised when other pixels are made of the same files."""


class _Job(NamedTuple):
    root: Path
    mask_folder: str | None
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    downscale: float
    request: Request


_ChooseTurns = Callable[[], tuple[int, bool]]


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
        self._lock = threading.Lock()
        self._way: tuple[int, bool] | None = None

    def read(self, i: int) -> LoadedView:
        """Decodes one view.

        Raises:
            SceneError: for everything wrong with its files.
        """
        with self._named(i):
            return _read_view(
                self._job, self._files[i], self._full[i], self._K[i], self._distortions[i], self._choose_turns
            )

    def inspect(self, i: int) -> InspectedView:
        """Checks one view's files to their last byte, and that its mask is not empty, without decoding its
        photograph.

        Raises:
            SceneError: for everything wrong with them that shows.
        """
        with self._named(i):
            plan = repr((self._full[i], self._K[i].tolist(), self._distortions[i], *self._job[2:4]))
            return _inspect_view(self._job, self._files[i], self._full[i], plan)

    def _choose_turns(self) -> tuple[int, bool]:
        """For masks whose size fits their photograph turned and not: which way most of them are, and whether
        that is clear."""
        with self._lock:
            if self._way is None:
                scores: list[list[float]] = []
                for file, full in zip(self._files, self._full, strict=True):
                    if file.mask is not None and len(scores) < _LOOKED_AT:
                        with suppress(SceneError):  # told of the view when it is read
                            scores += _score_turns(
                                self._job, file.mask, _open_photograph(self._job, file, full)
                            )
                self._way = orientation.choose(scores) if scores else (0, False)
            return self._way

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
    """Width and height as they are used: turned upright where `turned`."""
    alpha: bool
    """Whether it promises transparency."""
    orientation: int
    """EXIF's tag."""
    turned: bool
    """Whether the pixels are turned by the tag, because the camera's size demands it."""
    target: tuple[int, int]
    """Width and height that are wanted."""


def _open_photograph(job: _Job, file: ViewFiles, full: tuple[int, int]) -> _Photograph:
    path = inside(job.root, file.image, outside=job.request.allow_outside)
    data = images.read_file(path)
    size, alpha, orientation = images.read_header(data, path)
    upright = size[::-1] if orientation >= 5 else size
    turned = upright != size and not _fits_camera(size, full, job.factor)
    if turned and _fits_camera(upright, full, job.factor):
        size = upright
    else:
        turned = False
        _check_size(size, full, job.factor, path)
    width, height = (s if job.factor > 1 else max(1, round(s / job.downscale)) for s in size)
    return _Photograph(path, data, size, alpha, orientation, turned, (width, height))


def _inspect_view(job: _Job, file: ViewFiles, full: tuple[int, int], plan: str) -> InspectedView:
    photo = _open_photograph(job, file, full)
    state = hashlib.sha256(f"{_VERSION} {plan} {job.request.mask_source}".encode())
    state.update(photo.data)
    if photo.orientation != 1:
        state.update(b"turned by its tag where sizes or outlines ask for it")
    outside = job.request.allow_outside
    for relative in (file.mask, file.ignore, file.excluded, file.depth):
        if relative is not None and (other := inside(job.root, relative, outside=outside)).is_file():
            state.update(hashlib.sha256(images.read_file(other)).digest())
    masked = photo.alpha and job.request.mask_source != "folder"
    if file.mask is not None or (masked and job.request.allow_missing_masks):
        soft, mask_path, _ = _read_mask(job, file, photo, lambda: (0, False))
        masked = soft is not None
        if soft is not None:
            masks.refuse_empty(_resize(soft, *photo.target) > 0.5, float(soft.max()), mask_path)
    if not masked and not job.request.allow_missing_masks:
        _no_mask(job, file, photo.path)
    for relative in (file.ignore, file.excluded):
        if relative is not None:
            _open_other(job, relative, photo, "mask of ignored pixels")
    depth = None if file.depth is None else inside(job.root, file.depth, outside=outside)
    return InspectedView(
        size=photo.target,
        masked=masked,
        ignoring=file.ignore is not None or file.excluded is not None,
        deep=depth is not None and depth.is_file(),
        fingerprint=state.hexdigest(),
    )


def _read_view(
    job: _Job,
    file: ViewFiles,
    full: tuple[int, int],
    K: np.ndarray,
    distortion: Distortion | None,
    choose_turns: _ChooseTurns,
) -> LoadedView:
    photo = _open_photograph(job, file, full)
    opacity, mask_path, remarks = _read_mask(job, file, photo, choose_turns)
    if photo.turned:
        remarks = (
            f"turned upright by EXIF orientation {photo.orientation}, as the camera's size asks",
            *remarks,
        )
    masked = opacity is not None
    if not masked and not job.request.allow_missing_masks:
        _no_mask(job, file, photo.path)
    soft = np.ones((1, 1), np.float32) if opacity is None else opacity
    image = _decode_turned(photo)
    unknown = _read_ignored(job, file, photo, choose_turns)
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
        remarks=remarks,
    )


def _fits_camera(size: tuple[int, int], full: tuple[int, int], factor: float) -> bool:
    """Whether a photograph is what its camera saw: at the size expected, or evenly resized as a whole."""
    near = factor if factor > 1 else 0
    exact = all(abs(s * factor - f) <= near for s, f in zip(size, full, strict=True))
    return exact or masks.fits(size, full)


def _check_size(size: tuple[int, int], full: tuple[int, int], factor: float, path: Path) -> None:
    if _fits_camera(size, full, factor):
        return
    small = f", which at 1/{factor:g} is {full[0] / factor:g} x {full[1] / factor:g}" if factor > 1 else ""
    sideways = _fits_camera(size[::-1], full, factor)
    raise SceneError(
        f"the image is {size[0]} x {size[1]} but its camera says {full[0]} x {full[1]}{small}",
        where=path,
        cause="the image was turned by a quarter after the poses were estimated, as programs do that follow the "
        "orientation tag of EXIF and drop it"
        if sideways
        else "the images were undistorted, cropped or unevenly resized after the poses were estimated",
        todo="turn it back by a quarter, or put the images there that the model was made from"
        if sideways
        else "put the images there that the model was made from; smaller copies go to images_<F>",
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


def _score_turns(job: _Job, mask: str, photo: _Photograph) -> list[list[float]]:
    """`outline_contrast` in each way that a mask's size allows, as a row; no row where there is but one way."""
    other = _open_other(job, mask, photo, "mask")
    if len(other.turns) == 1:
        return []
    image, opacity = _decode_turned(photo), masks.decode_mask(other.data, other.path).opacity
    turned = [orientation.apply(opacity, turns) for turns in other.turns]
    return [[orientation.outline_contrast(image, way) for way in turned]]


def _decode_turned(photo: _Photograph) -> np.ndarray:
    image = images.decode_photograph(photo.data, photo.path)
    return images.turn(image, photo.orientation) if photo.turned else image


def _read_mask(
    job: _Job, file: ViewFiles, photo: _Photograph, choose_turns: _ChooseTurns
) -> tuple[np.ndarray | None, Path, tuple[str, ...]]:
    """(H, W) float32 opacity at the file's own size, the file, and remarks; None where there is no mask."""
    source, alpha = job.request.mask_source, None
    if photo.alpha and source != "folder":
        alpha = masks.decode_alpha(images.decode_any(photo.data, photo.path))
        if alpha is not None and photo.turned:
            alpha = alpha._replace(opacity=images.turn(alpha.opacity, photo.orientation))
    if source == "alpha" or (file.mask is None and source != "folder"):
        return (None if alpha is None else alpha.opacity), photo.path, ()
    if file.mask is None:
        return None, photo.path, ()
    other = _open_other(job, file.mask, photo, "mask")
    turns, remark = _only_turns(other, photo, choose_turns)
    found = masks.decode_mask(other.data, other.path)
    found = found._replace(opacity=orientation.apply(found.opacity, turns))
    if alpha is not None:
        masks.refuse_two(found, alpha, other.path, photo.path)
    return found.opacity, other.path, remark


class _Other(NamedTuple):
    data: bytes
    path: Path
    turns: list[orientation.Turns]
    """Ways in which it can be turned to fit its photograph."""


def _open_other(job: _Job, relative: str, photo: _Photograph, what: str) -> _Other:
    path = inside(job.root, relative, outside=job.request.allow_outside)
    data = images.read_file(path)
    header = images.read_header(data, path)
    ways = orientation.possible_turns(photo.orientation, photo.turned, header.orientation)
    ways = [turns for turns in ways if masks.fits(orientation.turned_size(header.size, turns), photo.size)]
    if ways:
        return _Other(data, path, ways)
    width, height = header.size
    sideways = masks.fits((height, width), photo.size)
    raise SceneError(
        f"the {what} is {width} x {height} but its image is {photo.size[0]} x {photo.size[1]}",
        where=path,
        cause=f"the {what} or the image was turned by a quarter, and says nothing of it"
        if sideways
        else f"the {what} was made of another image: one cropped, or not undistorted as this one is",
        todo=f"turn the {what} by a quarter"
        if sideways
        else f"make the {what} from the image, at any size of the same shape",
    )


def _only_turns(
    other: _Other, photo: _Photograph, choose_turns: _ChooseTurns
) -> tuple[orientation.Turns, tuple[str, ...]]:
    """The way in which a mask is turned, and what is to be said about it."""
    way, clear = choose_turns() if len(other.turns) > 1 else (0, True)
    turns = other.turns[way]
    if not clear:
        return turns, (
            f"photographs with EXIF orientation {photo.orientation}, whose masks may be turned against them: "
            "neither sizes nor outlines tell; the pixels are taken as they are stored",
        )
    if not turns:
        return turns, ()
    return turns, (
        f"masks turned to match their photographs, which have EXIF orientation {photo.orientation}"
        if photo.orientation > 1
        else f"masks turned by their EXIF orientation {turns[0]}",
    )


def _resize(soft: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average where the picture gets smaller, else the nearest value."""
    if soft.shape[0] >= height and soft.shape[1] >= width:
        return images.shrink(soft, width, height)
    return images.shrink_nearest(soft, width, height)


def _read_ignored(
    job: _Job, file: ViewFiles, photo: _Photograph, choose_turns: _ChooseTurns
) -> np.ndarray | None:
    ignore = None
    for relative, black_is_unknown in ((file.ignore, True), (file.excluded, False)):
        if relative is None:
            continue
        other = _open_other(job, relative, photo, "mask of ignored pixels")
        turns, _ = _only_turns(other, photo, choose_turns)
        values = orientation.apply(masks.decode_mask(other.data, other.path).opacity, turns)
        unknown = values <= 0.5 if black_is_unknown else values > 0
        unknown = _resize(unknown.astype(np.float32), *photo.size) > 0
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
