"""Orientation tags of photographs and their masks: which of the two was turned, and what brings them together.

A viewer turns a picture by EXIF's tag, a program that estimates poses usually does not, and a program that cuts
out objects may save its masks upright. Sizes tell mostly; for half turns and square pictures, outlines do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from datamodules.files.images import turn, undo_turn

Turns = tuple[int, ...]
"""Tags by which pixels are turned, one after the other."""
_CLEAR = 0.15


def turned_size(size: tuple[int, int], turns: Turns) -> tuple[int, int]:
    """Width and height after all turns."""
    return size[::-1] if sum(tag >= 5 for tag in turns) % 2 else size


def apply(pixels: np.ndarray, turns: Turns) -> np.ndarray:
    """(H, W, ...) pixels after all turns."""
    for tag in turns:
        pixels = turn(pixels, tag)
    return pixels


def possible_turns(photograph: int, upright: bool, mask: int) -> list[Turns]:
    """Turns that bring a mask's pixels into the frame in which its photograph is used; the likelier first.

    Args:
        photograph: tag of the photograph.
        upright: whether the photograph is used turned by its tag, not as stored.
        mask: tag of the mask.
    """
    if upright:
        return [_plain(mask)] if mask == photograph else [_plain(mask), _plain(photograph)]
    if mask == photograph:
        return [()]
    return [(), (*_plain(mask), *_plain(undo_turn(photograph)))]


def outline_contrast(image: np.ndarray, opacity: np.ndarray) -> float:
    """How much more a photograph changes along a mask's outline than elsewhere, as a logarithm; 0 is no more.

    Args:
        image: (H, W, 3) uint8.
        opacity: (h, w) float32 in [0, 1], of the same picture at any size.
    """
    import cv2

    height, width = image.shape[:2]
    scale = min(1.0, 512 / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    mask = (cv2.resize(opacity, size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
    change = sum(np.abs(cv2.Sobel(grey, cv2.CV_32F, *axis)).sum(-1) for axis in ((1, 0), (0, 1)))
    outline = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    if not outline.any() or outline.all():
        return 0.0
    return math.log((change[outline].mean() + 1) / (change[~outline].mean() + 1))


def choose(scores: Sequence[Sequence[float]]) -> tuple[int, bool]:
    """Which of several ways is right, by `outline_contrast` of some views in each, and whether that is clear."""
    mean = np.asarray(scores, np.float64).mean(0)
    best = int(mean.argmax())
    return (best, True) if mean[best] - np.delete(mean, best).max() > _CLEAR else (0, False)


def _plain(tag: int) -> Turns:
    return () if tag == 1 else (tag,)
