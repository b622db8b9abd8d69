"""Grids at half, a quarter, ... of the resolution, and back."""

from __future__ import annotations

import numpy as np


def pool(occupancy: np.ndarray, factor: int) -> np.ndarray:
    """Cubes of factor^3 voxels, 1 where any of them is in.

    Args:
        occupancy: (X, Y, Z) bool; sides that are no multiples are filled up with empty voxels at their ends.
        factor: edge of a cube, voxels.

    Returns:
        (X / factor, Y / factor, Z / factor) uint8, rounded up.
    """
    for axis in range(3) if factor > 1 else ():
        size = occupancy.shape[axis]
        ends = [(0, -size % factor if a == axis else 0) for a in range(3)]
        shape = (*occupancy.shape[:axis], -(-size // factor), factor, *occupancy.shape[axis + 1 :])
        occupancy = np.any(np.pad(occupancy, ends).reshape(shape), axis=axis + 1)
    return np.ascontiguousarray(occupancy, np.uint8)


def refine(u: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A grid of twice the resolution, linear between the centres of the coarse voxels.

    Args:
        u: (X, Y, Z) float32.
        shape: of the result, at most (2 X, 2 Y, 2 Z): what is beyond is cut off.
    """
    for axis in range(3):
        u = np.moveaxis(u, axis, 0)
        fine = np.empty((2 * len(u), *u.shape[1:]), np.float32)
        before, after = np.concatenate([u[:1], u[:-1]]), np.concatenate([u[1:], u[-1:]])
        fine[::2] = np.float32(0.75) * u + np.float32(0.25) * before
        fine[1::2] = np.float32(0.75) * u + np.float32(0.25) * after
        u = np.moveaxis(fine[: shape[axis]], 0, axis)
    return np.ascontiguousarray(u)
