"""Photographs that were given as masks, told from soft masks by their colours and by the photograph itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datamodules.files import images
from visdom_plugin.errors import SceneError

COLOURFUL = 16
"""Of 255, between a colour's channels: less comes of reducing a grey picture to a palette."""
DOUBTFUL = 0.1
"""Share of a mask's pixels that are grey from which on it may be no mask; soft outlines have less."""
_GREY = (0.1, 0.9)
_TONES = 4
"""Of eight levels per channel, so many different colours: the areas of a label image have few."""
_LEAST, _CORRELATED, _FLAT = 0.02, 0.9, 0.02
_PARTS = 0.5
"""Brightness above which a mask's pixel is object."""
_SIDE = 256
"""Pixels along the longer side at which a mask and its photograph are compared."""


def grey_share(opacity: np.ndarray) -> float:
    """Share of pixels that are neither nearly black nor nearly white."""
    return float(_is_grey(opacity).mean())


def is_colourful(pixels: np.ndarray) -> bool:
    """Whether many pixels of a file (H, W, C) are grey by their brightest channel, and in many colours."""
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        return False
    full = np.iinfo(pixels.dtype).max
    colours = np.right_shift(pixels[..., :3], pixels.dtype.itemsize * 8 - 8).astype(np.uint8)
    coloured = _is_grey(pixels[..., :3].max(-1) / np.float32(full)) & (np.ptp(colours, axis=2) > COLOURFUL)
    if coloured.mean() < DOUBTFUL:
        return False
    codes = (colours[coloured] >> 5).astype(np.int64) @ np.array([64, 8, 1])
    counts = np.bincount(codes).astype(float)
    return bool(counts.sum() ** 2 / (counts**2).sum() > _TONES)


def refuse_photograph(
    opacity: np.ndarray, colourful: bool, photograph: np.ndarray | None, path: Path
) -> None:
    """Raises SceneError for a mask that is evidently a photograph; what is only soft, as mattes are, passes.

    Args:
        opacity: (H, W) float32 in [0, 1], what the file says as a mask.
        colourful: `is_colourful` of the file.
        photograph: (H', W', 3) uint8 of the same view, where it has been decoded.
    """
    same = photograph is not None and _shows(opacity, photograph)
    if not (same or colourful):
        return
    cause = "the folder holds photographs, or cut-outs that were saved without an alpha channel"
    if same:
        cause = f"the file shows what the photograph shows: {cause}"
    raise SceneError(
        "the mask is a photograph, not black and white",
        where=path,
        cause=cause,
        todo="save each mask white on the object and black around it, or as a cut-out with an alpha channel; "
        "--masks FOLDER names their folder. visdom-prepare makes masks where it is given none",
        topic="mask-grey",
    )


def _is_grey(opacity: np.ndarray) -> np.ndarray:
    return (opacity > _GREY[0]) & (opacity < _GREY[1])


def _shows(opacity: np.ndarray, photograph: np.ndarray) -> bool:
    """Whether a mask's grey values follow the brightness of its photograph, both where they are counted as object
    and where not."""
    if grey_share(opacity) < DOUBTFUL:
        return False
    height, width = np.minimum(opacity.shape, photograph.shape[:2])
    scale = min(1.0, _SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    mask, photo = (images.shrink(x, *size) for x in (opacity.astype(np.float32), photograph))
    brightness = (photo.max(-1), photo @ np.array([0.299, 0.587, 0.114]))
    grey = _is_grey(mask)
    parts = [part for part in (grey & (mask > _PARTS), grey & (mask <= _PARTS)) if part.mean() > _LEAST]
    varied = [part for part in parts if mask[part].std() > _FLAT]
    if not varied or len(varied) < len(parts):
        return False
    return any(
        all(b[part].std() > 0 and _correlation(mask[part], b[part]) > _CORRELATED for part in varied)
        for b in brightness
    )


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    return abs(float(np.corrcoef(one, other)[0, 1]))
