"""The plane that the object stands on, seen without the object, and where each view differs from it.

Every view is laid onto the plane z = 0; the median over the views shows the plane itself, board, table and
shadows, because the object hides another part of it in each view. A pixel that differs from the plane there shows
something else: the object, or what stands about.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras

LEAST_VIEWS = 4
"""Views needed: fewer do not outvote the object."""
_MAP_PX = 640
_REACHES = (3.0, 12.0)
"""Sides of a fine and a coarse map, in longest sides of the box: low views look far past the object."""
_UNSURE = 8.0
"""Median difference between views, in Lab, from which a place of the plane is not known."""
_MOST_VIEWS = 16
_NEAR = 1e-3
_WINDOW = 5
"""Pixels about a place of the plane that may be shifted or blurred against each other."""


def differences(cameras: Cameras, images: Sequence[np.ndarray], box: np.ndarray) -> list[np.ndarray]:
    """How much each view differs from the plane below the box.

    Args:
        cameras: (N,) of the images.
        images: N x (h, w, 3) uint8 RGB.
        box: (2, 3) corners of the space that the object is in; the plane is its floor, z = box[0, 2].

    Returns:
        N x (h, w) float32 in units of Lab colour; NaN where too few views show the plane.
    """
    import cv2

    lab = [cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB) for image in images]
    fine, coarse = (_differ(cameras, lab, box, reach) for reach in _REACHES)
    return [np.where(np.isnan(f), c, f) for f, c in zip(fine, coarse, strict=True)]


def _differ(cameras: Cameras, lab: Sequence[np.ndarray], box: np.ndarray, reach: float) -> list[np.ndarray]:
    """`differences` on a map of `reach` longest sides of the box."""
    side = reach * float((box[1] - box[0]).max())
    middle = box.mean(0)[:2]
    from_map = np.array(
        [
            [side / _MAP_PX, 0, middle[0] - side / 2],
            [0, side / _MAP_PX, middle[1] - side / 2],
            [0, 0, 1.0],
        ]
    )
    maps = [_onto_view(cameras[i], float(box[0, 2])) @ from_map for i in range(len(lab))]
    chosen = np.unique(np.linspace(0, len(lab) - 1, min(_MOST_VIEWS, len(lab))).round().astype(int))
    seen = np.stack([_lay(lab[i], maps[i]) for i in chosen])
    with np.errstate(all="ignore"):
        plane = _median(seen)
        for _ in range(2):
            # Exposure and white balance differ from view to view.
            shift = _median((plane - seen).reshape(len(seen), -1, 3), 1)
            plane = _median(seen + shift[:, None, None])
        spread = _median(np.abs(seen + shift[:, None, None] - plane).max(-1))
    plane[np.isfinite(seen[..., 0]).sum(0) < LEAST_VIEWS - 1] = np.nan
    plane[_is_hidden(spread)] = np.nan
    return [_compare(image, plane, onto) for image, onto in zip(lab, maps, strict=True)]


def _is_hidden(spread: np.ndarray) -> np.ndarray:
    """Where the object hides the plane from most views, as under its foot: these see different things there.

    Edges on the plane differ, too, by blur; they are thin.
    """
    import cv2

    return cv2.erode(np.nan_to_num(spread).astype(np.float32), np.ones((7, 7), np.uint8)) > _UNSURE


def _median(seen: np.ndarray, axis: int = 0) -> np.ndarray:
    """Of what is not NaN, over one axis; NaN where all is. Of an even number the lower of the two."""
    return torch.from_numpy(seen).nanmedian(axis).values.numpy()


def _onto_view(camera: Cameras, height: float) -> np.ndarray:
    """(3, 3) from (x, y, 1) of the plane to homogeneous pixels of the view, the last one being its depth."""
    world = camera.camera_from_world.to(torch.float64).numpy()
    local = np.stack([world[:3, 0], world[:3, 1], world[:3, 2] * height + world[:3, 3]], -1)
    return camera.intrinsics.to(torch.float64).numpy() @ local


def _lay(image: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """The view on the map, (M, M, 3) float32, NaN where it does not see it."""
    import cv2

    v, u = np.mgrid[:_MAP_PX, :_MAP_PX] + 0.5
    q = np.stack([u, v, np.ones_like(u)], -1) @ onto.T
    with np.errstate(all="ignore"):
        at = np.where(q[..., 2:] > _NEAR, q[..., :2] / q[..., 2:], -1e6).astype(np.float32) - 0.5
    return cv2.remap(
        image,
        at[..., 0],
        at[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(np.nan,) * 3,
    )


def _compare(image: np.ndarray, plane: np.ndarray, onto: np.ndarray) -> np.ndarray:
    import cv2

    height, width = image.shape[:2]
    back = np.linalg.inv(onto)
    v, u = np.mgrid[:height, :width] + 0.5
    q = np.stack([u, v, np.ones_like(u)], -1) @ back.T
    # The inverse's last coordinate is one over the depth, up to a factor that is the same for all pixels.
    front = q[..., 2] * np.sign(np.linalg.det(back) * np.linalg.det(onto)) > 0
    with np.errstate(all="ignore"):
        at = np.where(front[..., None], q[..., :2] / q[..., 2:], -1e6).astype(np.float32) - 0.5
    known = np.nan_to_num(plane)
    valid = np.isfinite(plane[..., 0]).astype(np.float32)
    expected = cv2.remap(known, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    there = cv2.remap(valid, at[..., 0], at[..., 1], cv2.INTER_LINEAR) > 0.99
    shift = np.zeros(3, np.float32)
    if there.any():
        shift = np.median((expected - image)[there], axis=0)
    window = np.ones((_WINDOW, _WINDOW), np.uint8)
    image = image + shift
    over = image - cv2.dilate(expected, window)
    under = cv2.erode(expected, window) - image
    # Brightness counts half: shadows and highlights move with the eye, colours hardly.
    beyond = np.maximum(np.maximum(over, under), 0) * np.array([0.6, 1.0, 1.0], np.float32)
    return np.where(there, np.sqrt((beyond**2).sum(-1)), np.nan).astype(np.float32)
