"""Photographs, masks and depth maps from files: header checks first, then decoding and exact downscaling.

Only PNG and JPEG are read. The size is taken from the header and compared with what the camera asks for
before a pixel is decoded, and the file is checked for its end: the decoders underneath fill what is missing
with grey and say nothing.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from datamodules.files.paths import read_plain
from visdom_plugin.errors import SceneError

MAX_PIXELS = 2**28


def read_file(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        SceneError: it is missing or cannot be read.
    """
    try:
        return read_plain(path)
    except FileNotFoundError:
        raise SceneError(
            "an image file is missing", where=path, todo="copy it there, or take the view off the index files"
        ) from None
    except (OSError, ValueError) as error:
        raise SceneError(
            f"an image file cannot be read: {getattr(error, 'strerror', None) or error}",
            where=path,
            todo="make it a plain file that you may read",
        ) from error


class Header(NamedTuple):
    """What an image file says of itself before its pixels are decoded."""

    size: tuple[int, int]
    """Width and height in pixels, as stored."""
    alpha: bool
    """Whether it promises transparency: an alpha channel, a transparent colour, a palette's transparency."""


def read_header(data: bytes, path: Path) -> Header:
    """The header of a complete PNG or JPEG; no pixel is decoded.

    Raises:
        SceneError: another format, a damaged header or chunk, or a file that stops before its end.
    """
    png = data.startswith(b"\x89PNG\r\n\x1a\n")
    if not png and not data.startswith(b"\xff\xd8"):
        raise SceneError(
            "the file is neither PNG nor JPEG" if data else "the file is empty",
            where=path,
            cause="another format behind this extension, or an interrupted copy",
            todo="convert it to PNG or JPEG, or copy it again",
        )
    stream = io.BytesIO(data)
    try:
        image = (PngImageFile if png else JpegImageFile)(stream)
        width, height = image.size
        complete = data.rfind(b"IEND\xaeB`\x82" if png else b"\xff\xd9") >= stream.tell()
        if png:
            image.verify()  # walks the chunks to the last one and compares their checksums
    except Exception as error:  # Pillow raises whatever it comes across
        _damaged(
            path, f"the {'PNG' if png else 'JPEG'} is damaged, or stops before its end: {str(error)[:120]}"
        )
    if not complete:
        _damaged(path, f"the {'PNG' if png else 'JPEG'} stops before its end")
    # Deflate makes at most 1032 bytes of one, and a JPEG's block of 8 x 8 pixels takes at least one bit: a
    # larger claim is a bomb, or a damaged header.
    most = len(data) * (8 * 1032 // max(1, data[24] * len(image.getbands())) if png else 512)
    if not 0 < width * height <= min(MAX_PIXELS, most):
        _damaged(path, f"the image claims to be {width} x {height} but holds {len(data)} bytes")
    alpha = "transparency" in image.info or image.mode in ("LA", "PA", "RGBA")
    return Header((width, height), alpha)


def decode_photograph(data: bytes, path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored: EXIF orientation is ignored, as COLMAP does; alpha is dropped."""
    import cv2

    image = _decode(data, path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def decode_any(data: bytes, path: Path) -> np.ndarray:
    """(H, W) or (H, W, C) as stored, uint8 or uint16; colours as BGR or BGRA, palettes and 1 bit spread out.

    EXIF orientation is ignored.
    """
    import cv2

    image = _decode(data, path, cv2.IMREAD_UNCHANGED)
    if image.ndim == 2 and image.dtype == np.uint8 and read_header(data, path).alpha:
        # OpenCV passes over the transparent level of a grey picture.
        return np.asarray(PngImageFile(io.BytesIO(data)).convert("LA"))
    return image


def decode_depth(data: bytes, path: Path) -> np.ndarray:
    """(H, W) float32: a 16-bit PNG of monocular depth times 1000, divided by 1000 again."""
    import cv2

    image = _decode(data, path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise SceneError(
            f"a depth map must be a 16-bit grey PNG, this one has shape {image.shape} and type {image.dtype}",
            where=path,
            cause="the coloured preview was saved in its place",
            todo="save depth x 1000 as 16-bit PNG, or remove the folder zoe_depth to train without it",
        )
    return image.astype(np.float32) / np.float32(1000)


def shrink(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Exact area average of an (H, W) or (H, W, 3) image at a smaller size, type kept."""
    import cv2

    if image.shape[:2] == (height, width):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def shrink_cut_out(image: np.ndarray, opacity: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of an (H, W, 3) uint8 cut-out, each pixel weighted by its opacity (H, W) in [0, 1].

    What is transparent has a colour, too, usually black, which would darken the smaller picture's edges.
    """
    if image.shape[:2] == (height, width):
        return image
    weight = shrink(opacity.astype(np.float32), width, height)[..., None]
    colour = shrink(image.astype(np.float32) * opacity[..., None], width, height)
    mean = np.clip(np.rint(colour / np.maximum(weight, 1e-6)), 0, 255).astype(np.uint8)
    return np.where(weight > 1e-6, mean, shrink(image, width, height))


def shrink_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The value nearest to each new pixel centre: depth must not be averaged across edges."""
    rows = ((np.arange(height) + 0.5) * (image.shape[0] / height)).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * (image.shape[1] / width)).astype(np.int64)
    return np.ascontiguousarray(image[rows[:, None], columns])


def _decode(data: bytes, path: Path, flags: int) -> np.ndarray:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        _damaged(path, "the image cannot be decoded")
    return image


def _damaged(path: Path, what: str) -> NoReturn:
    raise SceneError(
        what, where=path, cause="an interrupted copy or a damaged disk", todo="copy the file again"
    )
