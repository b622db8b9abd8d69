"""The contact sheet of a prepared scene: photographs with their masks' outlines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from visdom_plugin.figures.canvas import Canvas

_CELL, _LABEL = 320, 36
_ROOM = 0.5
"""Around the object, in sizes of it, on each side."""
_INSET = 0.28
"""Longest side of the whole photograph in a corner, in cells."""
_OUTLINES = ((255, 0, 255), (0, 255, 255), (255, 255, 0), (0, 255, 0), (255, 0, 0))
"""Of which the outline has the one that the photograph lacks most."""
_NEAR = 200
"""Differences of two colours, summed over the channels, up to which they are alike."""


def draw_outlines(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray | None],
    names: Sequence[str],
    said: Sequence[str],
) -> np.ndarray:
    """The sheet, (H, W, 3) uint8 RGB: each object with what surrounds it, the whole photograph small in a corner.

    What is no object is faded, and the mask's outline is drawn; a photograph without a mask is shown whole.

    Args:
        images: N x (H, W, 3) uint8.
        masks: N x (H, W) bool, None for a view without.
        said: a line beneath each name.
    """
    columns = max(1, min(len(images), math.ceil(math.sqrt(1.5 * len(images)))))
    tall = _CELL + _LABEL
    sheet = Canvas(-(-len(images) // columns) * tall + 6, columns * (_CELL + 6) + 6, 24)
    for k, (image, mask, name, text) in enumerate(zip(images, masks, names, said, strict=True)):
        picture = _fit(image, _CELL) if mask is None or not mask.any() else _draw_object(image, mask)
        x, y = 6 + k % columns * (_CELL + 6), 6 + k // columns * tall
        sheet.paste(picture, x + (_CELL - picture.shape[1]) // 2, y + (_CELL - picture.shape[0]) // 2)
        sheet.write(name, x + 2, y + _CELL + 13, (230, 230, 230), _CELL)
        sheet.write(text, x + 2, y + _CELL + 28, (170, 170, 170), _CELL)
    return sheet.draw()


def _draw_object(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    import cv2

    rows, columns = _window(mask)
    picture = _fit(image[rows, columns], _CELL)
    size = picture.shape[1], picture.shape[0]
    small = cv2.resize(mask[rows, columns].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    colour = _missing_colour(picture)
    grey = 0.5 * picture.mean(-1, keepdims=True) + 0.25 * picture
    picture = np.ascontiguousarray(np.where(small[..., None], picture, grey).astype(np.uint8))
    lines, _ = cv2.findContours(small.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, lines, -1, colour, 1)
    whole = _fit(image, round(_INSET * _CELL))
    scale = whole.shape[1] / image.shape[1]
    first = round(scale * columns.start), round(scale * rows.start)
    last = round(scale * columns.stop) - 1, round(scale * rows.stop) - 1
    cv2.rectangle(whole, first, last, colour, 1)
    height, width = whole.shape[:2]
    ends_of = [(slice(0, n), slice(-n, None)) for n in (height, width)]
    corners = list(itertools.product(*ends_of))
    free = min(corners, key=lambda corner: int(small[corner].sum()))
    if small[free].shape == (height, width):
        picture[free] = whole
    return picture


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of a square about the object, as far as the picture reaches."""
    ends = [np.flatnonzero(mask.any(axis))[[0, -1]] for axis in (1, 0)]
    half = math.ceil((0.5 + _ROOM) * (max(high - low for low, high in ends) + 1))
    middles = [int(low + high + 1) // 2 for low, high in ends]
    rows, columns = (
        slice(max(0, middle - half), min(length, middle + half))
        for middle, length in zip(middles, mask.shape, strict=True)
    )
    return rows, columns


def _missing_colour(picture: np.ndarray) -> tuple[int, int, int]:
    """The outline's colour: of `_OUTLINES` the one that the fewest pixels come near."""
    pixels = picture.reshape(-1, 3).astype(int)

    def near(colour: tuple[int, int, int]) -> int:
        return int((np.abs(pixels - colour).sum(1) < _NEAR).sum())

    return min(_OUTLINES, key=near)


def _fit(image: np.ndarray, longest: int) -> np.ndarray:
    """The picture so large that its longest side is this."""
    import cv2

    scale = longest / max(image.shape[:2])
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
