"""Photographs, masks and depth maps from files: header checks first, then decoding and exact downscaling.

The size is taken from the header and compared with what the camera asks for before a pixel is decoded. PNG and
JPEG are decoded by OpenCV, the other formats by Pillow.
"""

from __future__ import annotations

import io
from importlib import import_module
from pathlib import Path, PurePath
from typing import NamedTuple, NoReturn

import numpy as np
from PIL import Image
from PIL.ImageFile import ImageFile

from visdom_plugin.errors import SceneError

MAX_PIXELS = 2**28
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
"""Of the files of these formats, in lower case; PNG first, as masks are looked for in this order."""
_CLUTTER = ("@eaDir", "__MACOSX")
_MARKS = {"PNG": b"IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}
"""How files end of the formats that OpenCV decodes; it fills what is missing with grey and says nothing."""
_LOSSLESS = ("PNG", "TIFF", "BMP")
_PLUGINS = {
    "PNG": ("PIL.PngImagePlugin", "PngImageFile"),
    "JPEG": ("PIL.JpegImagePlugin", "JpegImageFile"),
    "WEBP": ("PIL.WebPImagePlugin", "WebPImageFile"),
    "TIFF": ("PIL.TiffImagePlugin", "TiffImageFile"),
    "BMP": ("PIL.BmpImagePlugin", "BmpImageFile"),
    "AVIF": ("PIL.AvifImagePlugin", "AvifImageFile"),
    "HEIC": ("pillow_heif", "HeifImageFile"),
}
_ORIENTATION = 0x0112


class Header(NamedTuple):
    """What an image file says of itself before its pixels are decoded."""

    size: tuple[int, int]
    """Width and height in pixels, as stored."""
    alpha: bool
    """Whether it promises transparency: an alpha channel, a transparent colour, a palette's transparency."""
    orientation: int = 1
    """EXIF's tag, 1 to 8: how a viewer turns the stored pixels. TIFF is decoded upright, so it has 1."""


def is_image_name(relative: PurePath) -> bool:
    """Whether a path below a scene's folder is called like an image.

    What systems leave beside images is called alike: ._v01.png of macOS, thumbnails in @eaDir, .hidden files.
    """
    parts = relative.parts
    return relative.suffix.lower() in ENDINGS and not any(p[0] == "." or p in _CLUTTER for p in parts)


def read_header(data: bytes, path: Path) -> Header:
    """The header of a complete image file; no pixel is decoded.

    Raises:
        SceneError: a format that is not read, a damaged header or chunk, or a file that stops before its end.
    """
    kind = _kind(data, path)
    try:
        image, end = _open(data, kind, path)
        complete = kind not in _MARKS or data.rfind(_MARKS[kind]) >= end
        if kind == "PNG":
            image.verify()  # walks the chunks to the last one and compares their checksums
    except SceneError:
        raise
    except Exception as error:  # Pillow raises whatever it comes across
        _damaged(path, f"the {kind} is damaged, or stops before its end: {str(error)[:120]}")
    if not complete:
        _damaged(path, f"the {kind} stops before its end")
    try:
        exif = Image.Image.getexif(image) if kind != "TIFF" else {}  # PngImageFile's own would decode
        orientation = exif.get(_ORIENTATION, 1)
    except Exception:  # EXIF data that nothing reads turns no viewer's picture either
        orientation = 1
    width, height = image.size
    most = MAX_PIXELS
    # Deflate makes at most 1032 bytes of one, and a JPEG's block of 8 x 8 pixels takes at least one bit: a
    # larger claim is a bomb, or a damaged header.
    if kind == "PNG":
        most = min(most, len(data) * 8 * 1032 // max(1, data[24] * len(image.getbands())))
    elif kind == "JPEG":
        most = min(most, len(data) * 512)
    if not 0 < width * height <= most:
        _damaged(path, f"the image claims to be {width} x {height} but holds {len(data)} bytes")
    alpha = "transparency" in image.info or image.mode in ("LA", "PA", "RGBA")
    return Header((width, height), alpha, orientation if orientation in range(1, 9) else 1)


def turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """(H, W, ...) pixels as a viewer shows them that follows EXIF's orientation tag, 1 to 8."""
    if orientation in (5, 6, 7, 8):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def undo_turn(orientation: int) -> int:
    """The tag that turns back what another one turned."""
    return {6: 8, 8: 6}.get(orientation, orientation)


def decode_photograph(data: bytes, path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB, as stored: EXIF orientation is ignored, as COLMAP does; alpha is dropped."""
    import cv2

    if _kind(data, path) in _MARKS:
        image = _decode(data, path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    image = decode_any(data, path)
    image = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    return np.repeat(image[..., None], 3, -1) if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])


def decode_any(data: bytes, path: Path) -> np.ndarray:
    """(H, W) or (H, W, C) as stored, uint8 or uint16; colours as BGR or BGRA, palettes and 1 bit spread out.

    EXIF orientation is ignored.
    """
    import cv2

    kind = _kind(data, path)
    if kind in _MARKS:
        stored = _decode(data, path, cv2.IMREAD_UNCHANGED)
        # OpenCV passes over the transparent level of a grey picture.
        if stored.ndim == 3 or stored.dtype != np.uint8 or not read_header(data, path).alpha:
            return stored
    try:
        image: Image.Image = _open(data, kind, path)[0]
        image.load()
        if image.mode.startswith("I;16"):
            return np.asarray(image).astype(np.uint16)
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            grey = image.mode in ("1", "L")
            clear = "transparency" in image.info or image.mode in ("PA", "La", "RGBa")
            image = image.convert("L" if grey and not clear else "RGBA" if clear else "RGB")
        elif "transparency" in image.info:
            image = image.convert("LA" if image.mode == "L" else "RGBA")
    except SceneError:
        raise
    except Exception as error:  # Pillow raises whatever it comes across
        _damaged(path, f"the {kind} cannot be decoded: {str(error)[:120]}")
    pixels = np.asarray(image)
    if pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
    return np.ascontiguousarray(pixels)


def decode_palette(data: bytes, path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """(H, W) uint8 indices of an opaque palette image and its (256, 3) uint8 RGB palette; None of other images."""
    kind = _kind(data, path)
    if kind not in _LOSSLESS:
        return None
    try:
        image: Image.Image = _open(data, kind, path)[0]
        if image.mode != "P" or "transparency" in image.info:
            return None
        indices, palette = np.asarray(image), np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
        missing = np.zeros((256 - len(palette), 3), np.uint8)
    except Exception as error:  # Pillow raises whatever it comes across
        _damaged(path, f"the {kind} cannot be decoded: {str(error)[:120]}")
    return indices, np.concatenate([palette, missing])


def is_lossless(data: bytes, path: Path) -> bool:
    """Whether the file's format keeps every value as it was saved, so that small numbers are no noise."""
    return _kind(data, path) in _LOSSLESS


def decode_depth(data: bytes, path: Path) -> np.ndarray:
    """(H, W) float32 monocular depth, 0 where unknown: a 16-bit PNG of it times 1000, divided by 1000 again, or an
    array of numpy as it is."""
    import cv2

    if path.suffix.lower() == ".npy":
        return _depth_array(data, path)
    image = _decode(data, path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise SceneError(
            f"a depth map must be a 16-bit grey PNG, this one has shape {image.shape} and type {image.dtype}",
            where=path,
            cause="the coloured preview was saved in its place",
            todo=f"save depth x 1000 as 16-bit PNG, or remove the folder {path.parent.name} to train without it",
            topic="depth",
        )
    return image.astype(np.float32) / np.float32(1000)


def _depth_array(data: bytes, path: Path) -> np.ndarray:
    try:
        found = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        _damaged(path, f"the array cannot be read: {str(error)[:120]}")
    depth = np.squeeze(found) if isinstance(found, np.ndarray) else np.zeros(0)
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise SceneError(
            f"a depth map must be an array of numbers (H, W), this one has shape {depth.shape} and type "
            f"{depth.dtype}",
            where=path,
            todo="save the depth alone with numpy.save, larger where farther, 0 where unknown",
            topic="depth",
        )
    depth = depth.astype(np.float32)
    return np.where(np.isfinite(depth), depth, np.float32(0))


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


def _kind(data: bytes, path: Path) -> str:
    """The format, by the file's first bytes."""
    brand = data[8:12] if data[4:8] == b"ftyp" else b""
    for kind, fits in (
        ("PNG", data.startswith(b"\x89PNG\r\n\x1a\n")),
        ("JPEG", data.startswith(b"\xff\xd8")),
        ("WEBP", data.startswith(b"RIFF") and data[8:12] == b"WEBP"),
        ("TIFF", data.startswith((b"II*\0", b"MM\0*"))),
        ("BMP", data.startswith(b"BM")),
        ("AVIF", brand in (b"avif", b"avis")),
        ("HEIC", brand in (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")),
    ):
        if fits:
            return kind
    if not data:
        _damaged(path, "the file is empty")
    raise SceneError(
        f"the file is none of {', '.join(_PLUGINS)}",
        where=path,
        cause="another format behind this extension, or an interrupted copy",
        todo="convert it to PNG or JPEG, or copy it again",
        topic="photograph",
    )


def _open(data: bytes, kind: str, path: Path) -> tuple[ImageFile, int]:
    """The file as Pillow's plugin opens it, without its limit on sizes, and how far its header reaches."""
    module, name = _PLUGINS[kind]
    try:
        plugin = getattr(import_module(module), name)
    except ImportError as error:
        extra = "'visdom-plugin[heic]'" if kind == "HEIC" else "'pillow>=11.3'"
        raise SceneError(
            f"the file is {kind}, which is not read here yet",
            where=path,
            todo=f"pip install {extra}, or convert it to PNG or JPEG",
            topic="photograph",
        ) from error
    stream = io.BytesIO(data)
    return plugin(stream), stream.tell()


def _damaged(path: Path, what: str) -> NoReturn:
    raise SceneError(
        what, where=path, cause="an interrupted copy or a damaged disk", todo="copy the file again"
    )
