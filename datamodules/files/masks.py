"""What the pixels of mask files mean.

A foreground mask is white (or opaque) on the object; what is outside is known to be empty. An ignore file is
white where the photograph tells nothing. The two are different files in different folders and are never taken
for one another.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from datamodules.files import images
from datamodules.files.not_a_mask import COLOURFUL, is_colourful
from visdom_plugin.errors import SceneError

MOST_ENLARGED = 10
"""A mask more than this many times wider than its image is refused before it is decoded."""
MOST_LABELS, LARGEST_LABEL = 32, 63
"""An image of more, or larger, grey values is no label image but a soft mask."""
_VOID = 255
_VOC_VOID = 192 << 16 | 224 << 8 | 224  # blue, green, red of Pascal VOC's outlines
_SOLID = 0.25
_NEARLY_FULL = 0.93
_SOFT = (0.02, 0.98)
_AGREED = 0.01


class Mask(NamedTuple):
    """A foreground mask as its file has it."""

    opacity: np.ndarray
    """(H, W) float32 in [0, 1]; above one half is object."""
    soft: float
    """Share of the pixels that are neither black nor white."""
    labelled: bool = False
    """Whether the file's values are numbers of objects: 0 is background, all others are object."""
    unknown: np.ndarray | None = None
    """(H, W) bool, True where the file says that nothing is known; None where it never does."""
    colourful: bool = False
    """`not_a_mask.is_colourful` of a file whose brightness is the mask."""


def fits(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) are one picture at two resolutions, the smaller one's sides rounded.

    Nobody makes a copy a few per cent smaller: such sizes are those of a picture undistorted or cropped.
    """
    small, large = sorted((size, other))
    low = max((s - 0.5) / o for s, o in zip(small, large, strict=True))
    high = min((s + 0.5) / o for s, o in zip(small, large, strict=True))
    if size != other and high > _NEARLY_FULL:
        return False
    return low <= high and max(size) <= MOST_ENLARGED * max(other)


def decode_mask(data: bytes, path: Path) -> Mask:
    """A foreground mask from L, LA, RGB, RGBA, palette, 1-bit, 8-bit or 16-bit PNG or JPEG.

    Its alpha channel is the mask where it varies; else a label image is object where its value is not 0, and
    unknown at its value for void, 255; else its brightest colour channel is the mask.

    Raises:
        SceneError: two readings are possible, and they disagree.
    """
    pixels = images.decode_any(data, path)
    alpha = alpha_of(pixels)
    colour = pixels if pixels.ndim == 2 else pixels[..., : 3 if pixels.shape[2] >= 3 else 1].max(-1)
    full = np.float32(np.iinfo(pixels.dtype).max)
    colour = colour.astype(np.float32) / full
    if alpha is None:
        labels = _find_labels(data, path, pixels)
        if labels is not None:
            numbers, void = labels
            unknown = None if void is None else numbers == void
            known = numbers > 0 if unknown is None else (numbers > 0) & ~unknown
            return Mask(known.astype(np.float32), 0.0, True, unknown)
        return _measured(colour)._replace(colourful=is_colourful(pixels))
    alpha = alpha.astype(np.float32) / full
    # A cut-out's colours are a photograph; only colours that are black and white could be meant as a mask.
    if colour.min() != colour.max() and soft_share(colour) < _AGREED and _differ(colour, alpha):
        raise SceneError(
            "the mask's colours and its alpha channel are two different masks",
            where=path,
            cause="a mask that was saved with an alpha channel of another one",
            todo="save it as a grey image without alpha channel",
            topic="mask-ambiguous",
        )
    return _measured(alpha)


def _find_labels(data: bytes, path: Path, pixels: np.ndarray) -> tuple[np.ndarray, int | None] | None:
    """(H, W) numbers of objects where the file is a label image, and the number for what is unknown; else None.

    That is a palette in colours, or a few small grey values with 0 among them, in a format without loss. Beside
    such, 255 is void; so is the grey in the middle of a trimap, of which 255 is the object.
    """
    if (paletted := images.decode_palette(data, path)) is not None:
        indices, palette = paletted
        used = np.unique(indices)
        if len(used) > 1 and np.ptp(palette[used].astype(int), axis=1).max() > COLOURFUL:
            black = used[~palette[used].any(1)]
            if len(black) and black[0] != 0:
                raise SceneError(
                    f"the mask's palette has black, the usual background, at {black[0]} and another colour at 0",
                    where=path,
                    cause="a picture reduced to a palette, whose order says nothing",
                    todo="save the mask as a grey image with 0 and 255",
                    topic="mask-ambiguous",
                )
            labels = used[(used > 0) & (used <= LARGEST_LABEL)]
            return indices, _VOID if used[-1] == _VOID and 0 < len(labels) >= len(used) - 2 else None
    if pixels.ndim == 3 and pixels.shape[2] < 3:
        return None
    if pixels.ndim == 3 and (pixels[..., :1] != pixels[..., :3]).any():
        return _find_coloured_labels(pixels) if images.is_lossless(data, path) else None
    grey = pixels if pixels.ndim == 2 else pixels[..., 0]
    if grey.min() > 0 or not images.is_lossless(data, path):
        return None
    values = np.unique(grey)
    if len(values) == 3 and values[1] in (127, 128) and values[2] == _VOID:
        return grey, int(values[1])
    if not 1 < len(values) <= MOST_LABELS + 1:
        return None
    if values[-1] <= LARGEST_LABEL:
        return (grey, None) if len(values) <= MOST_LABELS else None
    if values[-1] not in (_VOID, np.iinfo(grey.dtype).max) or not 0 < values[-2] <= LARGEST_LABEL:
        return None
    # Numbers fill areas; what a scan or a resampling leaves beside black does not.
    if _solid_share(grey, (grey > 0) & (grey < values[-1])) < _SOLID:
        return None
    if _solid_share(grey, grey == values[-1]) > _SOLID:
        raise SceneError(
            f"the mask holds small numbers up to {values[-2]}, as label images do, and wide areas of "
            f"{values[-1]}: these could be the object, or what a label image leaves open",
            where=path,
            cause="a label image whose void value covers more than outlines, or a mask with marks in the dark",
            todo="save masks with 0 and 255 alone; what is unknown goes into a file of the same name in the "
            "folder ignore, white where nothing is known",
            topic="mask-ambiguous",
        )
    return grey, int(values[-1])


def _find_coloured_labels(pixels: np.ndarray) -> tuple[np.ndarray, int | None] | None:
    """The same for (H, W, C) BGR pixels in a few colours that fill areas, black being background."""
    if pixels.dtype != np.uint8 or np.ptp(pixels[..., :3], axis=2).max() <= COLOURFUL:
        return None
    codes = pixels[..., :3].astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    used, labels = np.unique(codes, return_inverse=True)
    labels = labels.reshape(codes.shape)
    if used[0] != 0 or len(used) > MOST_LABELS:
        return None
    labels = labels.astype(np.uint8)
    if _solid_share(labels, labels > 0) < _SOLID:
        return None
    void = np.flatnonzero(used == _VOC_VOID)
    return labels, int(void[0]) if len(void) and len(used) > 2 else None


def _solid_share(grey: np.ndarray, part: np.ndarray) -> float:
    """Share of a part's pixels that have the value of all within two pixels: little of outlines, most of areas."""
    import cv2

    size = np.ones((5, 5), np.uint8)
    ends = (
        move(grey, size, borderType=cv2.BORDER_CONSTANT, borderValue=0) for move in (cv2.erode, cv2.dilate)
    )
    flat = np.equal(*ends)
    return float((flat & part).sum() / max(part.sum(), 1))


def decode_alpha(pixels: np.ndarray) -> Mask | None:
    """The alpha channel of a photograph (H, W, C) as its mask; None where it has none or it is all the same."""
    alpha = alpha_of(pixels)
    return None if alpha is None else _measured(alpha.astype(np.float32) / np.iinfo(pixels.dtype).max)


def alpha_of(pixels: np.ndarray) -> np.ndarray | None:
    """(H, W) alpha channel where there is one and it varies, else None."""
    if pixels.ndim != 3 or pixels.shape[2] not in (2, 4):
        return None
    alpha = pixels[..., -1]
    return None if alpha.min() == alpha.max() else alpha


def refuse_two(file: Mask, alpha: Mask, file_path: Path, image_path: Path) -> None:
    """Raises SceneError where a mask's file and the photograph's alpha channel disagree."""
    one, other = file.opacity, alpha.opacity
    if one.shape != other.shape:
        one = images.shrink_nearest(one, other.shape[1], other.shape[0])
    if _differ(one, other):
        raise SceneError(
            f"two masks that disagree: the file {file_path.name} and the alpha channel of {image_path.name}",
            where=f"{file_path} and {image_path}",
            todo="say which one is meant: --data.mask-source folder, or --data.mask-source alpha",
            topic="mask-ambiguous",
        )


def refuse_empty(mask: np.ndarray, peak: float, path: Path) -> None:
    """Raises SceneError, with the likely cause, for a mask without foreground.

    Args:
        mask: (H, W) bool.
        peak: the largest opacity in the file.
    """
    if mask.any():
        return
    if 0 < peak < 0.02:
        cause, todo = (
            "the mask holds 0 and 1 where 0 and 255 are meant, or 8-bit values in a 16-bit file",
            "multiply the masks by 255, or save them with 8 bits",
        )
    elif 0.02 <= peak <= 0.5:
        cause, todo = (
            f"the mask's brightest value is {round(peak * 255)} of 255, and only what is above one half is object",
            "save the masks with 0 and 255",
        )
    elif peak > 0.5:
        cause, todo = "the object is thinner than a pixel at this size", "use a smaller --downscale"
    else:
        cause, todo = (
            "the segmentation found nothing in this view",
            "mask the object, drop the view, or remove the file and pass --data.missing-masks colour|hull",
        )
    raise SceneError(
        "the mask is empty: no pixel of it is foreground", where=path, cause=cause, todo=todo, topic="empty"
    )


def soft_share(opacity: np.ndarray) -> float:
    """Share of the pixels that are neither black nor white."""
    return float(((opacity > _SOFT[0]) & (opacity < _SOFT[1])).mean())


def _measured(opacity: np.ndarray) -> Mask:
    return Mask(opacity, soft_share(opacity))


def _differ(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two opacities, cut at one half, differ by more than 1 % of what either covers."""
    a, b = one > 0.5, other > 0.5
    return int((a ^ b).sum()) > _AGREED * int((a | b).sum())
