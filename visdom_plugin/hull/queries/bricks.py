"""An occupancy grid as rays walk it: bricks of 64 voxels, and how far ahead of each all is empty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

BRICK = 4
"""Voxels along a brick's edge."""
_FARTHEST = 255


class Bricks(NamedTuple):
    """An occupancy grid in bricks."""

    bits: np.ndarray
    """(A, B, C) uint64, bit x + 4 y + 16 z of a brick is voxel (x, y, z) in it."""
    ahead: np.ndarray
    """(8, A, B, C) uint8 edge of the largest empty cube of bricks that has this one in its corner, at most 255. In
    octant i + 2 j + 4 k it goes to smaller x if i, smaller y if j, smaller z if k; it may leave the grid."""


@kernel(counted=False)
def _pack(begin: int, end: int, grid: np.ndarray, bits: np.ndarray) -> None:
    nx, ny, nz = grid.shape
    for a in range(begin, end):
        for x in range(4 * a, min(4 * a + 4, nx)):
            for y in range(ny):
                base = (x & 3) + 4 * (y & 3)
                for z in range(nz):
                    if grid[x, y, z]:
                        bits[a, y >> 2, z >> 2] |= np.uint64(1) << np.uint64(base + 16 * (z & 3))


@kernel(counted=False)
def _look_ahead(begin: int, end: int, bits: np.ndarray, outside: np.ndarray, ahead: np.ndarray) -> None:
    """Largest empty cubes by dynamic programming: one more than the smallest of the seven bricks ahead."""
    na, nb, nc = bits.shape
    for octant in range(begin, end):
        i, j, k = 1 - 2 * (octant & 1), 1 - 2 * (octant >> 1 & 1), 1 - 2 * (octant >> 2)
        cubes = ahead[octant]
        for p in range(na):
            a = na - 1 - p if i > 0 else p
            for q in range(nb):
                b = nb - 1 - q if j > 0 else q
                row, word = cubes[a, b], bits[a, b]
                beside = cubes[a + i, b] if p > 0 else outside
                below = cubes[a, b + j] if q > 0 else outside
                across = cubes[a + i, b + j] if p > 0 and q > 0 else outside
                # The smallest of the four bricks one step ahead along z, from the step before.
                before = np.uint8(_FARTHEST - 1)
                for r in range(nc):
                    c = nc - 1 - r if k > 0 else r
                    sides = min(min(beside[c], below[c]), across[c])
                    best = np.uint8(min(min(sides, before), _FARTHEST - 1) + 1)
                    row[c] = np.uint8(0) if word[c] else best
                    before = np.uint8(min(sides, row[c]))


def build_bricks(occupancy: np.ndarray) -> Bricks:
    """Bricks of an (X, Y, Z) bool grid."""
    shape = tuple(-(-n // BRICK) for n in occupancy.shape)
    bits, ahead = np.zeros(shape, np.uint64), np.empty((8, *shape), np.uint8)
    parallel_for(_pack, shape[0], 1, occupancy.view(np.uint8), bits)
    parallel_for(_look_ahead, 8, 1, bits, np.full(shape[2], _FARTHEST - 1, np.uint8), ahead)
    return Bricks(bits, ahead)
