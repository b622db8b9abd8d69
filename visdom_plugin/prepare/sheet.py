"""The contact sheet of a prepared scene: photographs with their masks' outlines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from visdom_plugin.figures.canvas import Canvas

_CELL, _LABEL, _OUTLINE = 320, 36, (255, 214, 0)


def draw_outlines(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray | None],
    names: Sequence[str],
    said: Sequence[str],
) -> np.ndarray:
    """The sheet, (H, W, 3) uint8 RGB: what is no object is faded, the outline yellow.

    Args:
        images: N x (H, W, 3) uint8.
        masks: N x (H, W) bool, None for a view without.
        said: a line beneath each name.
    """
    import cv2

    columns = max(1, min(len(images), math.ceil(math.sqrt(1.5 * len(images)))))
    cells = []
    for image, mask in zip(images, masks, strict=True):
        height = max(1, round(image.shape[0] * _CELL / image.shape[1]))
        size, way = (_CELL, height), cv2.INTER_AREA if image.shape[1] > _CELL else cv2.INTER_LINEAR
        picture = cv2.resize(image, size, interpolation=way)
        if mask is not None:
            small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
            grey = 0.4 * picture.mean(-1, keepdims=True) + 0.15 * picture
            picture = np.where(small[..., None], picture, grey).astype(np.uint8)
            lines, _ = cv2.findContours(small.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            picture = np.ascontiguousarray(picture)
            cv2.drawContours(picture, lines, -1, _OUTLINE, 1, cv2.LINE_AA)
        cells.append(picture)
    tall = max(c.shape[0] for c in cells) + _LABEL
    sheet = Canvas(-(-len(cells) // columns) * tall + 6, columns * (_CELL + 6) + 6, 24)
    for k, (picture, name, text) in enumerate(zip(cells, names, said, strict=True)):
        x, y = 6 + k % columns * (_CELL + 6), 6 + k // columns * tall
        sheet.paste(picture, x, y)
        sheet.write(name, x + 2, y + picture.shape[0] + 13, (230, 230, 230), _CELL)
        sheet.write(text, x + 2, y + picture.shape[0] + 28, (170, 170, 170), _CELL)
    return sheet.draw()
