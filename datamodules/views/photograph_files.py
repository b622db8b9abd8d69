"""Photographs' files, compared with the size that their camera says and turned upright where it asks for that."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from datamodules.capture import Frame
from datamodules.files import images, masks
from datamodules.files.paths import inside, read_file
from datamodules.request import Request
from visdom_plugin.errors import SceneError


class Reading(NamedTuple):
    """How the views of one request are read."""

    root: Path
    mask_folder: str | None
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    downscale: float
    request: Request

    def find(self, relative: str) -> Path:
        """The path of a file that the data names below the root."""
        return inside(self.root, relative, outside=self.request.allow_outside)


class Photograph(NamedTuple):
    """A photograph's file whose header has been read."""

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
    remarks: tuple[str, ...]
    """What is to be said of its size."""

    def decode(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB at `size`."""
        return self.turn(images.decode_photograph(self.data, self.path))

    def turn(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (H, W, ...) as stored, in the frame in which the photograph is used."""
        return images.turn(pixels, self.orientation) if self.turned else pixels


def open_photograph(reading: Reading, file: Frame, full: tuple[int, int]) -> Photograph:
    """Reads a photograph's header.

    Args:
        full: width and height that the camera says.

    Raises:
        SceneError: the file is missing or damaged, or its size is not its camera's.
    """
    path = reading.find(file.image)
    data = read_file(path)
    size, alpha, orientation = images.read_header(data, path)
    upright = size[::-1] if orientation >= 5 else size
    turned = not _fits_camera(size, full, reading.factor) and _fits_camera(upright, full, reading.factor)
    if turned:
        size = upright
    elif not _fits_camera(size, full, reading.factor):
        _refuse_size(size, full, reading.factor, path)
    remarks = []
    if turned:
        remarks.append(f"turned upright by EXIF orientation {orientation}, as the camera's size asks")
    if not _is_expected(size, full, reading.factor):
        remarks.append(
            f"photographs of {size[0]} x {size[1]} for cameras of {full[0]} x {full[1]}: evenly resized after the "
            "poses were estimated, so the cameras follow"
        )
    width, height = (s if reading.factor > 1 else max(1, round(s / reading.downscale)) for s in size)
    return Photograph(path, data, size, alpha, orientation, turned, (width, height), tuple(remarks))


def _is_expected(size: tuple[int, int], full: tuple[int, int], factor: float) -> bool:
    near = factor if factor > 1 else 0
    return all(abs(s * factor - f) <= near for s, f in zip(size, full, strict=True))


def _fits_camera(size: tuple[int, int], full: tuple[int, int], factor: float) -> bool:
    """Whether a photograph is what its camera saw: at the size expected, or evenly resized as a whole."""
    return _is_expected(size, full, factor) or masks.fits(size, full)


def _refuse_size(size: tuple[int, int], full: tuple[int, int], factor: float, path: Path) -> None:
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
        topic="photograph-size",
    )
