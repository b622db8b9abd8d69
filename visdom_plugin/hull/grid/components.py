"""Connected pieces of a grid, labelled by runs of voxels along z: memory grows with the surface.

Voxels are neighbours when they share a face, an edge or a corner (26 neighbours), so that a thin part that steps
diagonally through the grid stays one piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

_ONES = np.uint64(0x0101010101010101)
_GRAIN = 16


class Pieces(NamedTuple):
    """Connected pieces, in the order of their first voxel."""

    sizes: np.ndarray
    """(C,) int64 voxels of each piece."""
    column_starts: np.ndarray
    """(X * Y + 1,) where each column's runs begin in the arrays below."""
    begins: np.ndarray
    """(R,) first z of a run."""
    ends: np.ndarray
    """(R,) one past the last z of a run."""
    labels: np.ndarray
    """(R,) piece of each run."""


@kernel()
def _count_runs(begin: int, end: int, grid: np.ndarray, counts: np.ndarray) -> None:
    _, ny, nz = grid.shape
    for x in range(begin, end):
        for y in range(ny):
            runs = 0
            before = np.uint8(0)
            for z in range(nz):
                value = grid[x, y, z]
                runs += value & ~before & 1
                before = value
            counts[x * ny + y] = runs


@kernel()
def _list_runs(
    begin: int, end: int, grid: np.ndarray, words: np.ndarray, starts: np.ndarray, begins: np.ndarray,
    ends: np.ndarray,
) -> None:  # fmt: skip
    _, ny, nz = grid.shape
    for x in range(begin, end):
        for y in range(ny):
            r = starts[x * ny + y]
            if r == starts[x * ny + y + 1]:
                continue
            before = np.uint8(0)
            z = 0
            while z < nz:
                # Eight voxels like the one before them hold no end of a run.
                if z & 7 == 0 and z >> 3 < words.shape[2] and words[x, y, z >> 3] == before * _ONES:
                    z += 8
                    continue
                value = grid[x, y, z]
                if value != before:
                    if value:
                        begins[r] = z
                    else:
                        ends[r] = z
                        r += 1
                    before = value
                z += 1
            if before:
                ends[r] = nz


@kernel()
def _root(parents: np.ndarray, r: int) -> int:
    while parents[r] != r:
        parents[r] = parents[parents[r]]
        r = parents[r]
    return r


@kernel()
def _join(
    nx: int, ny: int, starts: np.ndarray, begins: np.ndarray, ends: np.ndarray, parents: np.ndarray,
) -> None:  # fmt: skip
    for x in range(nx):
        for y in range(ny):
            here, stop = starts[x * ny + y], starts[x * ny + y + 1]
            if here == stop:
                continue
            for n in range(4):
                i, j = (x - 1, y + n - 1) if n < 3 else (x, y - 1)
                if i < 0 or j < 0 or j >= ny:
                    continue
                a, b, b_stop = here, starts[i * ny + j], starts[i * ny + j + 1]
                while a < stop and b < b_stop:
                    if begins[a] <= ends[b] and begins[b] <= ends[a]:
                        p, q = _root(parents, a), _root(parents, b)
                        parents[max(p, q)] = min(p, q)
                    if ends[a] < ends[b]:
                        a += 1
                    else:
                        b += 1


@kernel()
def _number(
    begins: np.ndarray, ends: np.ndarray, parents: np.ndarray, labels: np.ndarray, sizes: np.ndarray,
) -> int:  # fmt: skip
    count = 0
    for r in range(len(parents)):
        root = _root(parents, r)
        if root == r:
            labels[r] = count
            count += 1
        else:
            labels[r] = labels[root]
        sizes[labels[r]] += ends[r] - begins[r]
    return count


@kernel()
def _erase(
    begin: int, end: int, grid: np.ndarray, starts: np.ndarray, begins: np.ndarray, ends: np.ndarray,
    labels: np.ndarray, keep: np.ndarray,
) -> None:  # fmt: skip
    ny = grid.shape[1]
    for x in range(begin, end):
        for y in range(ny):
            for r in range(starts[x * ny + y], starts[x * ny + y + 1]):
                if not keep[labels[r]]:
                    grid[x, y, begins[r] : ends[r]] = 0


def find_pieces(occupancy: np.ndarray) -> Pieces:
    """Connected pieces of an (X, Y, Z) bool grid."""
    grid = occupancy.view(np.uint8)
    counts = np.zeros(grid.shape[0] * grid.shape[1], np.int64)
    parallel_for(_count_runs, len(grid), _GRAIN, grid, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    begins, ends = (np.empty(starts[-1], np.int32) for _ in range(2))
    aligned = grid.shape[2] % 8 == 0
    words = grid.view(np.uint64) if aligned else np.zeros((1, 1, 0), np.uint64)
    parallel_for(_list_runs, len(grid), _GRAIN, grid, words, starts, begins, ends)
    parents = np.arange(starts[-1])
    _join(grid.shape[0], grid.shape[1], starts, begins, ends, parents)
    labels, sizes = np.empty(starts[-1], np.int32), np.zeros(starts[-1], np.int64)
    count = _number(begins, ends, parents, labels, sizes)
    return Pieces(sizes[:count].copy(), starts, begins, ends, labels)


def erase_pieces(occupancy: np.ndarray, pieces: Pieces, keep: np.ndarray) -> None:
    """Clears, in place, the pieces whose entry in `keep` (C,) bool is False."""
    inputs = (pieces.column_starts, pieces.begins, pieces.ends, pieces.labels, keep)
    parallel_for(_erase, len(occupancy), _GRAIN, occupancy.view(np.uint8), *inputs)


@kernel()
def _look_up(
    begin: int, end: int, voxels: np.ndarray, ny: int, starts: np.ndarray, begins: np.ndarray,
    ends: np.ndarray, labels: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    for m in range(begin, end):
        column, z = voxels[m, 0] * ny + voxels[m, 1], voxels[m, 2]
        out[m] = -1
        for r in range(starts[column], starts[column + 1]):
            if begins[r] <= z < ends[r]:
                out[m] = labels[r]


def piece_of(voxels: np.ndarray, shape: Sequence[int], pieces: Pieces) -> np.ndarray:
    """(M,) piece of each of some voxels (M, 3) int64 of a grid, -1 where there is none."""
    out = np.empty(len(voxels), np.int64)
    inputs = (shape[1], pieces.column_starts, pieces.begins, pieces.ends, pieces.labels)
    parallel_for(_look_up, len(voxels), 1 << 14, voxels, *inputs, out)
    return out


def choose_pieces(sizes: np.ndarray, policy: str, min_fraction: float) -> np.ndarray:
    """(C,) bool: the pieces that stay under "all", "largest" (the first of equals) or "drop-small"."""
    if policy == "all" or len(sizes) < 2:
        return np.ones(len(sizes), bool)
    if policy == "largest":
        return np.arange(len(sizes)) == sizes.argmax()
    return sizes >= min_fraction * sizes.max()
