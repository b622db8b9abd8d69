"""Masks of all views together: from the plane and colours first, then corrected by what the other views say."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch

from datamodules.views.reader import map_on_cores
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.carve import carve_silhouettes
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.prepare.masks import plate
from visdom_plugin.prepare.masks.grabcut import (
    BACKGROUND,
    LIKELY_BACKGROUND,
    LIKELY_OBJECT,
    cut,
    enlarge,
    shrink,
    tidy,
)
from visdom_plugin.prepare.masks.volume import outline_of_box

log = logging.getLogger(__name__)

_SAME, _OTHER = 5.0, 14.0
"""Differences of colour, in Lab: up to the first a pixel shows the plane, from the second on something else."""
_RESOLUTION, _BAND = 128, 0.04
"""Of the hull that corrects masks, and its outline's leeway in object sizes."""
_LEAST_SHARE = 1e-4
"""Of a photograph: less that differs from the plane is no object."""


def cut_views(
    cameras: Cameras,
    images: Sequence[np.ndarray],
    names: Sequence[str],
    box: np.ndarray,
    *,
    plane: bool,
    rounds: int,
) -> list[np.ndarray]:
    """Masks N x (H, W) bool.

    Args:
        cameras: (N,) of the images.
        images: N x (H, W, 3) uint8, without lens distortion.
        box: (2, 3) corners of the space that the object is in.
        plane: whether the box stands on a plane that the views show, as a board on a table.
        rounds: of correction by the hull.
    """
    small = [shrink(image) for image in images]
    heights, widths = zip(*(s.shape[:2] for s in small), strict=True)
    less = cameras.resized(torch.tensor(widths), torch.tensor(heights))
    inside = outline_of_box(less, box, list(names))
    unlike = None
    if plane and len(images) >= plate.LEAST_VIEWS:
        unlike = plate.differences(less, small, box)
    starts = [_start(inside[i], None if unlike is None else unlike[i]) for i in range(len(small))]
    masks = _cut_all(small, starts)
    for _ in range(rounds):
        outlines = _outlines_of_hull(less, masks, box)
        if outlines is None:
            log.warning("the masks of the views have no hull in common; they are left as colours tell them")
            break
        corrected = [_correct(starts[i], masks[i], outlines[i]) for i in range(len(small))]
        masks = _cut_all(small, corrected)
    return map_on_cores(lambda i: tidy(enlarge(masks[i], images[i])), range(len(small)))


def _cut_all(images: Sequence[np.ndarray], labels: Sequence[np.ndarray]) -> list[np.ndarray]:
    return map_on_cores(lambda i: tidy(cut(images[i], labels[i])), range(len(images)))


def _start(inside: np.ndarray, unlike: np.ndarray | None) -> np.ndarray:
    """Labels before any colour model: the box, and in it what differs from the plane."""
    import cv2

    labels = np.where(inside, LIKELY_OBJECT, BACKGROUND).astype(np.uint8)
    if unlike is None:
        return labels
    other = np.nan_to_num(unlike) > _OTHER
    other = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    if (other & inside).sum() < _LEAST_SHARE * inside.size:
        return labels
    # Where the plane is not seen, colours decide: they start as background, which most of it is.
    labels[inside & ~other] = LIKELY_BACKGROUND
    # Far from anything that differs, the plane is seen: markers' colours teach the background.
    about = cv2.dilate(other.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    labels[inside & ~about & (np.nan_to_num(unlike, nan=np.inf) < _SAME)] = BACKGROUND
    return labels


def _outlines_of_hull(
    cameras: Cameras, masks: Sequence[np.ndarray], box: np.ndarray
) -> list[np.ndarray] | None:
    """What the views agree on, seen by each, N x (h, w) bool; None where they agree on nothing."""
    views = len(masks)
    misses = 0 if views < 5 else 1 if views < 10 else 2
    corners = tuple(tuple(float(x) for x in corner) for corner in box)
    settings = HullSettings(
        k=min(3, views), max_misses=misses, bounds=corners, resolution=_RESOLUTION, components="drop-small"  # type: ignore[arg-type]
    )  # fmt: skip
    hull = carve_silhouettes(settings, cameras, gather_silhouettes(cameras, list(masks), dilate_px=1))
    if hull is None:
        return None
    return [depth_and_silhouette(hull, cameras[i])[1].numpy() for i in range(views)]


def _correct(start: np.ndarray, mask: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Labels for the next cut: nothing far outside the hull is object, what the others see of it likely is."""
    import cv2

    band = max(1, round(_BAND * np.sqrt(max(1, int(outline.sum())))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    far = cv2.dilate(outline.astype(np.uint8), kernel) == 0
    labels = np.where(mask, LIKELY_OBJECT, LIKELY_BACKGROUND).astype(np.uint8)
    inner = cv2.erode(outline.astype(np.uint8), kernel) > 0
    labels[inner] = LIKELY_OBJECT
    labels[far | (start == BACKGROUND)] = BACKGROUND
    return labels
