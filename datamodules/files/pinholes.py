"""Pinhole cameras from the numbers of calibration files, checked before they are believed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from datamodules.files.images import MAX_PIXELS
from datamodules.files.paths import printable
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras


def pinholes(
    K: ArrayLike,
    world_from_camera: ArrayLike,
    sizes: Sequence[tuple[int, int]],
    *,
    names: Sequence[str],
    where: Path,
    convention: str = "opencv",
) -> Cameras:
    """Checked float64 cameras; faults are told by the view's name.

    Args:
        K: N rows fx, fy, cx, cy in pixels.
        world_from_camera: N matrices (3, 4) or (4, 4), nested sequences or arrays of finite size.
        sizes: N pairs width, height.

    Raises:
        SceneError: for impossible sizes, focal lengths or poses.
    """
    K = np.asarray(K, np.float64).reshape(-1, 4)
    motion = np.asarray(world_from_camera, np.float64)
    rows = 4 if names and motion.size == 16 * len(names) else 3
    motion = motion.reshape(len(names), rows, 4)[:, :3]
    for name, (fx, fy, cx, cy), pose, (width, height) in zip(names, K, motion, sizes, strict=True):
        fine = width > 0 and height > 0 and width * height <= MAX_PIXELS
        # Beyond these bounds float32 arithmetic on squared lengths overflows.
        fine = fine and bool(np.isfinite([fx, fy, cx, cy]).all()) and max(fx, fy, abs(cx), abs(cy)) < 1e9
        if not fine or min(fx, fy) < 1e-6:
            raise SceneError(
                f"the camera of image {printable(name)} is impossible: {width} x {height} pixels, focal lengths "
                f"{fx:g} and {fy:g}, principal point ({cx:g}, {cy:g})",
                where=where,
                cause="a damaged file, or a calibration that failed",
                todo="export the cameras again",
                topic="poses",
            )
        if not np.isfinite(pose).all() or np.abs(pose[:, 3]).max() > 1e15:
            raise SceneError(
                f"the pose of image {printable(name)} holds NaN, infinite or absurd numbers",
                where=where,
                cause="the pose estimation failed for this view, or the file is damaged",
                todo="drop the view from the data, or estimate its pose again",
                topic="poses",
            )
        off = np.abs(pose[:, :3].T @ pose[:, :3] - np.eye(3)).max() if np.abs(pose[:, :3]).max() < 2 else 9.0
        if off > 1e-3 or np.linalg.det(pose[:, :3]) < 0:
            raise SceneError(
                f"the pose of image {printable(name)} is no rotation with a translation",
                where=where,
                cause="a scaled or mirrored pose, or a damaged file",
                todo="remove scale and reflection from the matrices, or estimate the poses again",
                topic="poses",
            )
    matrices, poses = np.zeros((len(names), 3, 3)), np.zeros((len(names), 4, 4))
    matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] = K
    matrices[:, 2, 2] = poses[:, 3, 3] = 1
    poses[:, :3] = motion * np.array([1, -1, -1, 1] if convention == "opengl" else [1, 1, 1, 1])
    widths, heights = torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2).unbind(1)
    # Not through `from_matrices`: what it refuses in numbers of a library's caller, the check explains of a file.
    return Cameras(torch.from_numpy(matrices), torch.from_numpy(poses), widths, heights)
