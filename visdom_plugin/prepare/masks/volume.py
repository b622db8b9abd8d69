"""The box that the object lies in, and its outline in the views."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.prepare.settings import Volume


def board_volume(size_m: tuple[float, float], height: float | None) -> np.ndarray:
    """(2, 3) corners of the space above the board.

    Args:
        size_m: width and length of the board in metres.
        height: in metres; the board's length by default.
    """
    half = np.array(size_m) / 2
    top = max(size_m) if height is None else height
    if not 0 < top < 100:
        raise ConfigError(
            f"the object's height is {top:g} metres", where="--height", todo="give it in metres, such as 0.2"
        )
    return np.array([[-half[0], -half[1], 0.0], [half[0], half[1], top]])


def given_volume(box: Volume) -> np.ndarray:
    """(2, 3) corners of the box of the command line.

    Raises:
        ConfigError: a lower corner that is not below the upper one.
    """
    corners = np.array(box, np.float64).reshape(2, 3)
    if not (np.isfinite(corners).all() and (corners[0] < corners[1]).all()):
        raise ConfigError(
            f"--box {' '.join(f'{x:g}' for x in box)} is no box",
            todo="give x y z of the lower corner, then x y z of the upper one, in scene units",
        )
    return corners


def outline_of_box(cameras: Cameras, box: np.ndarray, names: list[str]) -> list[np.ndarray]:
    """Masks (H, W) bool, True where a view sees into the box.

    Raises:
        SceneError: a camera stands in the box, or does not see it.
    """
    import cv2

    corners = torch.tensor(list(itertools.product(*box.T)), dtype=torch.float64)
    uv, depth = project(cameras.to(dtype=torch.float64), corners)
    found = []
    for i, name in enumerate(names):
        mask = np.zeros((int(cameras.height[i]), int(cameras.width[i])), np.uint8)
        if bool((depth[i] > 0).all()):
            hull = cv2.convexHull(uv[i].numpy().astype(np.float32)).reshape(-1, 2)
            cv2.fillConvexPoly(mask, np.round(hull - 0.5).astype(np.int32), 1)
        if not mask.any():
            raise SceneError(
                f"the box that the object is in lies beside or behind the camera of {name}",
                where=f"{box[0].round(4).tolist()} to {box[1].round(4).tolist()}",
                cause="the object is elsewhere in the scene, or this view's pose is wrong",
                todo="say where it is: --box X0 Y0 Z0 X1 Y1 Z1, in scene units",
                topic="no-object",
            )
        found.append(mask.astype(bool))
    return found
