"""The pixels of views: photograph, mask, ignored pixels and depth, checked, undistorted and brought to size."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TypeVar

import numpy as np
import torch

from datamodules.capture import Calibration, Capture, Frame, InspectedView, LoadedView
from datamodules.files import images, masks
from datamodules.files.not_a_mask import grey_share, refuse_photograph
from datamodules.files.paths import printable, read_file
from datamodules.files.undistort import undistort
from datamodules.request import Request
from datamodules.views import orientation, side_files
from datamodules.views.photograph_files import Reading, open_photograph
from visdom_plugin.errors import SceneError

_T = TypeVar("_T")
_LOOKED_AT = 6
"""Views whose pixels decide whether masks are turned."""
_VERSION = 3
"""Raised when other pixels are made of the same files."""


class ViewReader:
    """Reads views of one request, each by its position, in any thread."""

    def __init__(
        self,
        files: Sequence[Frame],
        calibration: Calibration,
        factor: float,
        downscale: float,
        capture: Capture,
        request: Request,
    ):
        self._reading = Reading(capture.root, capture.mask_folder, factor, downscale, request)
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
            return self._read(i)

    def inspect(self, i: int) -> InspectedView:
        """Checks one view's files to their last byte, and that its mask is not empty, without decoding its
        photograph.

        Raises:
            SceneError: for everything wrong with them that shows.
        """
        with self._named(i):
            return self._inspect(i)

    def _read(self, i: int) -> LoadedView:
        reading, file, full, distortion = self._reading, self._files[i], self._full[i], self._distortions[i]
        photo = open_photograph(reading, file, full)
        found = side_files.read_mask(reading, file, photo, self._choose_turns)
        opacity, mask_path = found.opacity, found.path
        masked = opacity is not None
        if not masked and not reading.request.allow_missing_masks:
            side_files.refuse_unmasked(reading, file, photo)
        soft = np.ones((1, 1), np.float32) if opacity is None else opacity
        image = photo.decode()
        if found.colourful is not None:
            refuse_photograph(soft, found.colourful, image, mask_path)
        grey = grey_share(soft) if masked else 0.0
        unknown = side_files.read_ignored(reading, file, photo, found, self._choose_turns)
        if distortion is not None:
            scaled = self._K[i] * np.array([[photo.size[0] / full[0]], [photo.size[1] / full[1]], [1.0]])
            soft = side_files.resize(soft, *photo.size)
            flat = undistort(scaled, distortion, image, soft, unknown, where=photo.path)
            image, unknown = flat.image, flat.ignore
            soft = soft if flat.mask is None else flat.mask
        depth = side_files.read_depth(reading, file, full, photo.target)
        remarks = (*photo.remarks, *found.remarks)
        if depth is not None and distortion is not None:
            remarks += ("depth maps are taken to be of the photographs without lens distortion",)
        width, height = photo.target
        mask = np.ones((height, width), bool)
        if masked:
            mask = side_files.resize(soft, width, height) > 0.5
            masks.refuse_empty(mask, float(soft.max()), mask_path)
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
            depth=depth,
            masked=masked,
            soft=masks.soft_share(soft) if masked else 0.0,
            grey=grey,
            remarks=remarks,
        )

    def _inspect(self, i: int) -> InspectedView:
        reading, file, full = self._reading, self._files[i], self._full[i]
        photo = open_photograph(reading, file, full)
        plan = repr((full, self._K[i].tolist(), self._distortions[i], reading.factor, reading.downscale))
        state = hashlib.sha256(f"{_VERSION} {plan} {reading.request.mask_source}".encode())
        if reading.request.invert_masks:
            state.update(b"masks turned over")
        state.update(photo.data)
        if photo.orientation != 1:
            state.update(b"turned by its tag where sizes or outlines ask for it")
        for relative in (file.mask, file.ignore, file.excluded, file.depth):
            if relative is not None and (other := reading.find(relative)).is_file():
                state.update(hashlib.sha256(read_file(other)).digest())
        missing_allowed = reading.request.allow_missing_masks
        void, masked = False, photo.alpha and reading.request.mask_source != "folder"
        if file.mask is not None or (masked and missing_allowed):
            found = side_files.read_mask(reading, file, photo, lambda: (0, False))
            soft, mask_path = found.opacity, found.path
            masked, void = soft is not None, found.unknown is not None
            if soft is not None:
                if found.colourful is not None:
                    refuse_photograph(soft, found.colourful, None, mask_path)
                mask = side_files.resize(soft, *photo.target) > 0.5
                masks.refuse_empty(mask, float(soft.max()), mask_path)
        if not masked and not missing_allowed:
            side_files.refuse_unmasked(reading, file, photo)
        for relative in (file.ignore, file.excluded):
            if relative is not None:
                side_files.open_side_file(reading, relative, photo, "mask of ignored pixels")
        return InspectedView(
            size=photo.target,
            masked=masked,
            ignoring=void or file.ignore is not None or file.excluded is not None,
            deep=file.depth is not None and reading.find(file.depth).is_file(),
            fingerprint=state.hexdigest(),
        )

    def _choose_turns(self) -> tuple[int, bool]:
        """For masks whose size fits their photograph turned and not: which way most of them are, and whether
        that is clear."""
        with self._lock:
            if self._way is None:
                scores: list[list[float]] = []
                for file, full in zip(self._files, self._full, strict=True):
                    if file.mask is not None and len(scores) < _LOOKED_AT:
                        with suppress(SceneError):  # told of the view when it is read
                            photo = open_photograph(self._reading, file, full)
                            scores += side_files.score_turns(self._reading, file.mask, photo)
                self._way = orientation.choose(scores) if scores else (0, False)
            return self._way

    @contextmanager
    def _named(self, i: int) -> Iterator[None]:
        import cv2

        try:
            yield
        except (OSError, ValueError, cv2.error, MemoryError) as error:
            raise SceneError(
                f"view {printable(self._files[i].name)} cannot be read: {error}", where=self._reading.root
            ) from error


def map_on_cores(function: Callable[[int], _T], positions: Sequence[int]) -> list[_T]:
    """`function` of each position, on all cores.

    Raises:
        SceneError: the first (in the given order) that it raises, with the number of those that are alike.
    """

    def attempt(position: int) -> _T | SceneError:
        try:
            return function(position)
        except SceneError as error:
            return error

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        results = list(pool.map(attempt, positions))
    errors = [result for result in results if isinstance(result, SceneError)]
    if errors:
        alike = sum(error.what == errors[0].what for error in errors) - 1
        first = errors[0]
        if alike:
            others = "another view" if alike == 1 else f"{alike} other views"
            raise SceneError(
                f"{first.what}; the same of {others}",
                where=first.where,
                cause=first.cause,
                todo=first.todo,
                topic=first.topic,
            )
        raise first
    return [result for result in results if not isinstance(result, SceneError)]
