"""Photographs, masks and depth maps from files: header checks first, then decoding and exact downscaling.

Only PNG and JPEG are read. The size is taken from the header and compared with what the camera asks for
before a pixel is decoded, and the file is checked for its end: the decoders underneath fill what is missing
with grey and say nothing.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import NoReturn

import numpy as np

from datamodules.files.paths import read_plain
from visdom_plugin.errors import SceneError

MAX_PIXELS = 2**28
_PNG = b"\x89PNG\r\n\x1a\n"
# Start-of-frame markers of JPEG: all of 0xC0..0xCF but DHT (C4), JPG (C8) and DAC (CC).
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


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


def size_of(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height in pixels from the header of a complete PNG or JPEG.

    Raises:
        SceneError: another format, a damaged header or chunk, or a file that stops before its end.
    """
    if data.startswith((_PNG, b"\xff\xd8")):
        width, height = (_png_size if data.startswith(_PNG) else _jpeg_size)(data, path)
        if not 0 < width * height <= MAX_PIXELS:
            _damaged(path, f"the image claims to be {width} x {height}")
        return width, height
    raise SceneError(
        "the file is neither PNG nor JPEG" if data else "the file is empty",
        where=path,
        cause="another format behind this extension, or an interrupted copy",
        todo="convert it to PNG or JPEG, or copy it again",
    )


def decode_photograph(data: bytes, path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored: EXIF orientation is ignored, as COLMAP does; alpha is dropped."""
    import cv2

    image = _decode(data, path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def decode_mask(data: bytes, path: Path) -> np.ndarray:
    """(H, W) float32 in [0, 1] from any bit depth.

    An alpha channel that varies is the mask; else the brightest colour channel is.
    """
    from datamodules.files import masks

    return masks.decode(data, path).opacity


def decode_any(data: bytes, path: Path) -> np.ndarray:
    """(H, W) or (H, W, C) as stored, uint8 or uint16; colours as BGR or BGRA, palettes and 1 bit spread out.

    EXIF orientation is ignored.
    """
    import cv2

    return _decode(data, path, cv2.IMREAD_UNCHANGED)


def has_alpha(data: bytes) -> bool:
    """Whether a PNG promises transparency; False for everything else."""
    return data.startswith(_PNG) and len(data) > 25 and (data[25] in (4, 6) or b"tRNS" in data[:2048])


def decode_alpha(data: bytes, path: Path) -> np.ndarray | None:
    """(H, W) float32 in [0, 1], the alpha channel of a photograph; None where it has none or it never varies."""
    from datamodules.files import masks

    if not has_alpha(data):
        return None
    found = masks.decode_alpha(decode_any(data, path))
    return None if found is None else found.opacity


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


def _png_size(data: bytes, path: Path) -> tuple[int, int]:
    """Walks the chunks, checks each one's CRC (PNG specification, section 5) and that IEND is reached."""
    at, size, packed = len(_PNG), None, 0
    while True:
        if at + 12 > len(data):
            _damaged(path, "the PNG stops before its end")
        (length,), kind = struct.unpack_from(">I", data, at), data[at + 4 : at + 8]
        if at + 12 + length > len(data):
            _damaged(path, "the PNG stops before its end")
        (crc,) = struct.unpack_from(">I", data, at + 8 + length)
        if crc != zlib.crc32(memoryview(data)[at + 4 : at + 8 + length]):
            _damaged(path, f"the PNG's chunk {kind.decode('latin-1')!r} has a wrong checksum")
        if size is None:
            if kind != b"IHDR" or length != 13:
                _damaged(path, "the PNG does not begin with its header")
            size = struct.unpack_from(">II", data, at + 8)
            bits = data[at + 16] * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(data[at + 17], 4)
        packed += length if kind == b"IDAT" else 0
        if kind == b"IEND":
            # Deflate makes at most 1032 bytes of one: a larger claim is a bomb, or a damaged header.
            if size[1] * (size[0] * bits // 8) > 1032 * packed:
                _damaged(path, f"the image claims to be {size[0]} x {size[1]} but holds {packed} bytes")
            return size
        at += 12 + length


def _jpeg_size(data: bytes, path: Path) -> tuple[int, int]:
    """Walks the segments to the start of frame (ITU-T T.81, annex B) and looks for the end marker."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            _damaged(path, "the JPEG's header is damaged")
        marker = data[at + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            if data.rfind(b"\xff\xd9") < at:
                _damaged(path, "the JPEG stops before its end")
            # A block of 8 x 8 pixels takes at least one bit.
            if width * height > 512 * len(data):
                _damaged(path, f"the image claims to be {width} x {height} but holds {len(data)} bytes")
            return width, height
        (length,) = struct.unpack_from(">H", data, at + 2)
        at += 2 + max(length, 2)
    _damaged(path, "the JPEG stops inside its header")


def _damaged(path: Path, what: str) -> NoReturn:
    raise SceneError(
        what, where=path, cause="an interrupted copy or a damaged disk", todo="copy the file again"
    )
