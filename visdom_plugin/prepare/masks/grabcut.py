"""Masks by OpenCV's GrabCut, from what is surely object, surely not, or likely one of both.

GrabCut works on a small copy; the outline is then drawn along the edges of the photograph by a guided filter.
"""

from __future__ import annotations

from typing import Any

import numpy as np

BACKGROUND, OBJECT, LIKELY_BACKGROUND, LIKELY_OBJECT = range(4)
"""OpenCV's labels."""
WORKING_PX = 480
"""Longest side of the copy."""
_RADIUS, _EPSILON = 6, 1e-3
_BINS, _RARE = 32, 2e-4
"""Bins of a colour along each axis, and the share of the background below which it hardly has one."""
_LEAST = 20
"""Pixels of a colour model, at least."""


def cut(image: np.ndarray, labels: np.ndarray, rounds: int = 4) -> np.ndarray:
    """The object's pixels in a small photograph.

    Args:
        image: (h, w, 3) uint8 RGB.
        labels: (h, w) uint8, OpenCV's labels to start from.
        rounds: of GrabCut.

    Returns:
        (h, w) bool.
    """
    import cv2

    likely = np.isin(labels, (OBJECT, LIKELY_OBJECT))
    if likely.sum() < _LEAST or (~likely).sum() < _LEAST:
        return likely
    labels = labels.copy()
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    bgr = np.ascontiguousarray(image[..., ::-1])
    whole: Any = None
    cv2.grabCut(bgr, labels, whole, *models, rounds, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, (OBJECT, LIKELY_OBJECT))


def rarity(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """(h, w) bool: pixels of colours that the background hardly has.

    Args:
        image: (h, w, 3) uint8 RGB.
        background: (h, w) bool, what is surely background.
    """
    import cv2
    from scipy.ndimage import gaussian_filter

    bins = (cv2.cvtColor(image, cv2.COLOR_RGB2LAB) // (256 // _BINS)).astype(np.int64)
    index = (bins[..., 0] * _BINS + bins[..., 1]) * _BINS + bins[..., 2]
    counts = np.bincount(index[background], minlength=_BINS**3).astype(np.float64)
    share = gaussian_filter(counts.reshape(_BINS, _BINS, _BINS), 0.7).ravel() / max(1.0, counts.sum())
    return share[index] < _RARE


def shrink(image: np.ndarray) -> np.ndarray:
    """The copy to work on."""
    import cv2

    height, width = image.shape[:2]
    scale = min(1.0, WORKING_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def enlarge(mask: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A mask of the small copy at the photograph's size, its outline along the photograph's edges.

    Args:
        mask: (h, w) bool.
        image: (H, W, 3) uint8.

    Returns:
        (H, W) bool.
    """
    import cv2

    height, width = image.shape[:2]
    soft = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(_RADIUS * max(height, width) / 1000))
    guide = image.astype(np.float32) / 255
    return cv2.ximgproc.guidedFilter(guide, soft, radius, _EPSILON) > 0.5


def tidy(mask: np.ndarray, share: float = 0.004) -> np.ndarray:
    """Without pieces and holes smaller than a share of the object's area."""
    import cv2

    for value in (True, False):
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            (mask == value).astype(np.uint8), connectivity=8
        )
        if count > 2 or not value:
            least = share * max(1, int(mask.sum())) * (1.0 if value else 0.1)
            small = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] < least]
            mask = mask ^ np.isin(labels, small)
    return mask
