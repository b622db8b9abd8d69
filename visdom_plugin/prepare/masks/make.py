"""Masks of all views together: from the plane and colours first, then corrected by what the other views say."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from datamodules.views.reader import map_on_cores
from visdom_plugin.compute.waiting import counting
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.carve import carve_silhouettes
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.prepare.masks import plate
from visdom_plugin.prepare.masks.grabcut import (
    BACKGROUND,
    LIKELY_BACKGROUND,
    LIKELY_OBJECT,
    OBJECT,
    cut,
    enlarge,
    rarity,
    shrink,
    tidy,
)
from visdom_plugin.prepare.masks.volume import outline_of_box

log = logging.getLogger(__name__)

_SAME, _OTHER = 5.0, 14.0
"""Differences of colour, in Lab: up to the first a pixel shows the plane, from the second on something else."""
_ROOM, _MARGIN = 0.15, 0.1
"""Beside the object and beside its box, in sizes of it."""
_RESOLUTION, _BAND = 128, 0.04
"""Of the hull that corrects masks, and its outline's leeway in object sizes."""
_LEAST_SHARE = 1e-4
"""Of a photograph: less that differs from the plane is no object."""


class _Copies(NamedTuple):
    """Small copies of the parts of the views that show a box."""

    windows: list[tuple[slice, slice]]
    """Rows and columns of each part in its view."""
    images: list[np.ndarray]
    """(h, w, 3) uint8."""
    cameras: Cameras
    inside: list[np.ndarray]
    """(h, w) bool, where a copy shows the box."""


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
    passes = 3 + rounds
    with counting(f"making masks in {passes} passes", passes * len(images)) as count:
        masks, copies = _cut_together(cameras, images, names, box, plane, rounds, count)

        def whole(i: int) -> np.ndarray:
            mask = np.zeros(images[i].shape[:2], bool)
            mask[copies.windows[i]] = tidy(enlarge(masks[i], images[i][copies.windows[i]]))
            return mask

        return map_on_cores(whole, range(len(images)))


def _cut_together(
    cameras: Cameras,
    images: Sequence[np.ndarray],
    names: Sequence[str],
    box: np.ndarray,
    plane: bool,
    rounds: int,
    count: Callable[[np.ndarray], np.ndarray],
) -> tuple[list[np.ndarray], _Copies]:
    """The masks of small copies, and these; each mask that is cut on the way is counted."""
    for last in (False, True):
        copies = _copy(cameras, images, names, box)
        unlike: Sequence[np.ndarray | None] = [None] * len(images)
        if plane and len(images) >= plate.LEAST_VIEWS:
            unlike = plate.differences(copies.cameras, copies.images, box)
        starts = [_start(inside, other) for inside, other in zip(copies.inside, unlike, strict=True)]
        masks = _cut_all(copies.images, starts, count)
        for _ in range(rounds if last else 1):
            hull = _carve(copies.cameras, masks, box)
            if hull is None:
                log.warning(
                    "the masks of the views have no hull in common; they are left as colours tell them"
                )
                break
            outlines = [depth_and_silhouette(hull, copies.cameras[i])[1].numpy() for i in range(len(masks))]
            corrected = [
                _correct(*x) for x in zip(copies.images, starts, masks, outlines, unlike, strict=True)
            ]
            masks = _cut_all(copies.images, corrected, count)
        if not last:
            if hull is None:
                break
            # Closer, where the object has been seen to be.
            tight = np.asarray(hull.extent)
            room = _ROOM * (tight[1] - tight[0]).max()
            box = np.stack([np.maximum(box[0], tight[0] - room), np.minimum(box[1], tight[1] + room)])
    return masks, copies


def _copy(cameras: Cameras, images: Sequence[np.ndarray], names: Sequence[str], box: np.ndarray) -> _Copies:
    outlines = outline_of_box(cameras, box, list(names))
    windows, parts, K = [], [], cameras.intrinsics.clone()
    for i, outline in enumerate(outlines):
        window = []
        for axis in (1, 0):
            there = np.flatnonzero(outline.any(axis))
            room = round(_MARGIN * (there[-1] - there[0] + 1)) + 8
            window.append(slice(max(0, there[0] - room), min(outline.shape[1 - axis], there[-1] + 1 + room)))
        K[i, 0, 2] -= window[1].start
        K[i, 1, 2] -= window[0].start
        windows.append((window[0], window[1]))
        parts.append(images[i][windows[i]])
    small = [shrink(part) for part in parts]
    sizes = torch.tensor(
        [[[p.shape[1], p.shape[0]], [s.shape[1], s.shape[0]]] for p, s in zip(parts, small, strict=True)]
    )
    cropped = Cameras(K, cameras.world_from_camera, sizes[:, 0, 0], sizes[:, 0, 1])
    less = cropped.resized(sizes[:, 1, 0], sizes[:, 1, 1])
    return _Copies(windows, small, less, outline_of_box(less, box, list(names)))


def _cut_all(
    images: Sequence[np.ndarray], labels: Sequence[np.ndarray], count: Callable[[np.ndarray], np.ndarray]
) -> list[np.ndarray]:
    return map_on_cores(lambda i: count(tidy(cut(images[i], labels[i]))), range(len(images)))


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
    labels[inside] = LIKELY_BACKGROUND
    labels[inside & other] = OBJECT
    # Far from anything that differs, the plane is seen: markers' colours teach the background.
    about = cv2.dilate(other.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    labels[inside & ~about & (np.nan_to_num(unlike, nan=np.inf) < _SAME)] = BACKGROUND
    return labels


def _carve(cameras: Cameras, masks: Sequence[np.ndarray], box: np.ndarray) -> Hull | None:
    """What all but a few views agree on; None where they agree on nothing."""
    views = len(masks)
    low, high = (tuple(float(x) for x in corner) for corner in box)
    settings = HullSettings(
        k=min(3, views),
        max_misses=0 if views < 5 else 1 if views < 10 else 2,
        bounds=((low[0], low[1], low[2]), (high[0], high[1], high[2])),
        resolution=_RESOLUTION,
        components="drop-small",
    )
    return carve_silhouettes(settings, cameras, gather_silhouettes(cameras, list(masks), dilate_px=1))


def _correct(
    image: np.ndarray, start: np.ndarray, mask: np.ndarray, outline: np.ndarray, unlike: np.ndarray | None
) -> np.ndarray:
    """Labels for the next cut: nothing far outside the hull is object; what differs from the plane and what the
    others see of the hull likely is."""
    import cv2

    band = max(1, round(_BAND * np.sqrt(max(1, int(outline.sum())))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    far = cv2.dilate(outline.astype(np.uint8), kernel) == 0
    inner = cv2.erode(outline.astype(np.uint8), kernel) > 0
    labels = np.where(mask, LIKELY_OBJECT, LIKELY_BACKGROUND).astype(np.uint8)
    if unlike is None:
        labels[inner] = LIKELY_OBJECT
    else:
        # Where the plane says nothing: what the others demand, as far as the background has not its colour.
        rare = rarity(image, start == BACKGROUND) & ~cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
        labels[outline & np.isnan(unlike) & rare] = LIKELY_OBJECT
    labels[start == OBJECT] = OBJECT
    labels[far | (start == BACKGROUND)] = BACKGROUND
    return labels
