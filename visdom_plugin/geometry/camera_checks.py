"""Checks of camera matrices as they are handed in: not finite, transposed, scaled, or not in pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.errors import SceneError, list_some


def check_matrices(K: Tensor, world_from_camera: Tensor, width: Tensor, height: Tensor) -> None:
    """Refuses matrices that are no pinhole camera's, or intrinsics that are not in pixels.

    Args:
        K: (..., 3, 3) intrinsics.
        world_from_camera: (..., 4, 4) motions.
        width, height: (...) int64 pixels.

    Raises:
        SceneError: names the cameras, the likely cause and what to pass instead.
    """
    for name, matrix in (("intrinsics", K), ("world_from_camera", world_from_camera)):
        bad = ~torch.isfinite(matrix).flatten(-2).all(-1)
        if bad.any():
            raise SceneError(
                f"{name} of {_which(bad)} holds NaN or infinite numbers",
                cause="the pose estimation failed for this view",
                todo="drop the view or estimate its pose again",
                topic="poses",
            )
    _check_motion(world_from_camera)
    _check_form(K)
    bad = (width <= 0) | (height <= 0)
    if bad.any():
        raise SceneError(f"width and height of {_which(bad)} must be positive")
    _check_units(K, torch.stack([width, height], -1))


def _check_motion(world_from_camera: Tensor) -> None:
    rotation = world_from_camera[..., :3, :3]
    off = (rotation.mT @ rotation - torch.eye(3).to(rotation)).abs().amax((-2, -1))
    bad = (off > 1e-3) | (torch.linalg.det(rotation.double()) < 0)
    if bad.any():
        raise SceneError(
            f"the upper left 3 x 3 block of world_from_camera of {_which(bad)} is not a rotation",
            cause="a scaled or mirrored pose, or a matrix in row-major order taken for column-major",
            todo="remove scale and reflection; pass camera-to-world matrices",
            topic="poses",
        )
    last = world_from_camera[..., 3, :]
    bad = ((last - last.new_tensor([0.0, 0.0, 0.0, 1.0])).abs() > 1e-6).any(-1)
    if bad.any():
        raise SceneError(
            f"the last row of world_from_camera of {_which(bad)} is {_row(last, bad)}, not (0, 0, 0, 1)",
            cause="a transposed matrix, whose position stands in its last row, or a scaled one",
            todo="pass matrices that map columns, [R t; 0 0 0 1]: transpose them back",
            topic="poses",
        )


def _check_form(K: Tensor) -> None:
    form = "pass [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
    last = K[..., 2, :]
    bad = ((last - last.new_tensor([0.0, 0.0, 1.0])).abs() > 1e-6).any(-1)
    if bad.any():
        raise SceneError(
            f"the last row of the intrinsics of {_which(bad)} is {_row(last, bad)}, not (0, 0, 1)",
            cause="a transposed matrix, or one that is scaled or has the axes of another convention",
            todo=form,
            topic="poses",
        )
    skew = torch.maximum(K[..., 0, 1].abs(), K[..., 1, 0].abs())
    bad = (K[..., 0, 0] <= 0) | (K[..., 1, 1] <= 0) | (skew > 1e-6 * K[..., 0, 0].abs())
    if bad.any():
        raise SceneError(
            f"intrinsics of {_which(bad)} need positive focal lengths and no skew", todo=form, topic="poses"
        )


def _check_units(K: Tensor, size: Tensor) -> None:
    """Refuses intrinsics that are no pixels. Images of less than 16 pixels are too small to tell."""
    focal, centre = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1), K[..., :2, 2]
    cornered = ((centre >= 0) & (centre <= 1)).all(-1)
    bad = (size >= 16).all(-1) & (cornered | (focal * 16 < size).any(-1))
    if not bad.any():
        return
    fx, fy, cx, cy, w, h = torch.cat([focal, centre, size], -1)[bad].reshape(-1, 6)[0].tolist()
    cause = "an angle, a fraction of the image or millimetres as focal length"
    todo = "pass fx = width / (2 tan(angle / 2)), fy alike"
    if cornered[bad].any():
        cause, todo = "fractions of the image", "multiply cx by the width, cy by the height"
        if cx == cy == 0:
            cause, todo = "a centre left at 0", "pass cx about width / 2, cy about height / 2"
        if min(fx, fy) < 4:
            todo = "multiply K's first row by the width, its second by the height"
        elif fx <= min(180, w):
            todo += f"; and where {fx:.4g} is an angle in degrees, fx = width / (2 tan(angle / 2)), fy alike"
    values = f"fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g} for an image of {w:g} x {h:g}"
    raise SceneError(f"K of {_which(bad)} is not in pixels: {values}", cause=cause, todo=todo, topic="scale")


def _row(rows: Tensor, bad: Tensor) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in rows[bad].reshape(-1, rows.shape[-1])[0].tolist()) + ")"


def _which(bad: Tensor) -> str:
    if bad.ndim == 0:
        return "the camera"
    indices = bad.flatten().nonzero().flatten().tolist()
    return f"camera{'' if len(indices) == 1 else 's'} {list_some(indices, 6)}"
