"""One step of the flow without the silhouettes: a Gaussian blur, a soft threshold, a cap.

Blurring a shape and cutting it at one half moves its surface by its curvature times SIGMA^2 / 2 (Merriman, Bence
and Osher); cutting lower moves it outwards as well. The cut is soft: a surface is a ramp about RAMP voxels wide,
whose middle may lie between voxels. A step from 0 to 1 would stick to the grid where it moves under half a voxel.
"""

from __future__ import annotations

import math

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

SIGMA = 1.0
"""Standard deviation of the blur, voxels."""
RAMP = 2.5
"""Width of a surface's ramp from 0 to 1, voxels."""
NOTHING: np.ndarray = np.zeros((0, 0, 0), np.float32)
_REACH = 4
_DRIFT = 1.26
"""Speed of a flat ramp that is cut lower, in units of what its slope alone makes it: the cut's ends bend the ramp.
Measured in one dimension."""
_SLOPE = 1 / math.erf(RAMP / (2 * math.sqrt(2) * SIGMA))
"""Of the soft cut: after it, a blurred ramp of width RAMP has that width again."""


def blur_weights() -> np.ndarray:
    """(2 _REACH + 1,) float32 weights of the blur along one axis; their sum is 1."""
    x = np.arange(-_REACH, _REACH + 1)
    weights = np.exp(-0.5 * (x / SIGMA) ** 2)
    return (weights / weights.sum()).astype(np.float32)


def cut_level(radius: float) -> float:
    """Where the blurred shape is cut, so that a ball of this radius (voxels) neither grows nor shrinks."""
    # The blurred ramp rises by 1 / (_SLOPE RAMP) a voxel; a ball shrinks by SIGMA^2 / radius a step.
    return 0.5 - SIGMA**2 / (radius * _SLOPE * RAMP * _DRIFT)


@kernel()
def _blur_slabs(begin: int, end: int, u: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """Blurs the slabs x = const along y and z."""
    _, ny, nz = u.shape
    reach = len(weights) // 2
    padded = np.empty(nz + 2 * reach, np.float32)
    row = padded[reach : reach + nz]
    for k in range(reach):
        padded[k], padded[nz + reach + k] = 0, 0
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                row[k] = 0
            for t in range(max(-reach, -j), min(reach, ny - 1 - j) + 1):
                w = weights[t + reach]
                for k in range(nz):
                    row[k] += w * u[i, j + t, k]
            for k in range(nz):
                out[i, j, k] = 0
            for t in range(2 * reach + 1):
                w = weights[t]
                for k in range(nz):
                    out[i, j, k] += w * padded[k + t]


@kernel()
def _finish_rows(
    begin: int, end: int, half: np.ndarray, weights: np.ndarray, cut: float, slope: float, cap: np.ndarray,
    against: np.ndarray, blurred: np.ndarray, u: np.ndarray,
) -> None:  # fmt: skip
    """Blurs rows (x, y), flattened, along x; cuts and caps them."""
    nx, ny, nz = half.shape
    reach = len(weights) // 2
    for row in range(begin, end):
        i, j = row // ny, row % ny
        for k in range(nz):
            blurred[i, j, k] = 0
        for t in range(max(-reach, -i), min(reach, nx - 1 - i) + 1):
            w = weights[t + reach]
            for k in range(nz):
                blurred[i, j, k] += w * half[i + t, j, k]
        for k in range(nz):
            doubt = against[i, j, k] if len(against) else np.float32(0)
            value = np.float32(0.5) + slope * (blurred[i, j, k] - doubt - cut)
            value = min(max(value, np.float32(0)), np.float32(1))
            u[i, j, k] = value if cap[i, j, k] else np.float32(0)


def diffuse(
    u: np.ndarray,
    cap: np.ndarray,
    radius: float,
    half: np.ndarray,
    blurred: np.ndarray,
    against: np.ndarray = NOTHING,
) -> None:
    """One step, in place.

    Args:
        u: (X, Y, Z) float32 in [0, 1], the shape; above 0.5 is in. Comes out moved.
        cap: (X, Y, Z) uint8, 1 where the shape may be.
        radius: R, voxels.
        half: (X, Y, Z) float32, room to work in.
        blurred: (X, Y, Z) float32; comes out as the blurred shape.
        against: (X, Y, Z) float32, what speaks against each voxel, in units of the blurred shape; or `NOTHING`.
    """
    weights, (nx, ny, _) = blur_weights(), u.shape
    cut, slope = np.float32(cut_level(radius)), np.float32(_SLOPE)
    parallel_for(_blur_slabs, nx, 4, u, weights, half)
    parallel_for(_finish_rows, nx * ny, 256, half, weights, cut, slope, cap, against, blurred, u)
