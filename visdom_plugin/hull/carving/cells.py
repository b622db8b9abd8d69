"""What the keep rule says of single cells: of all points of one, or of its centre."""

from __future__ import annotations

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.carving.areas import Areas
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, axis_terms

DROPPED, KEPT, MIXED = 0, 1, 2
_UNSEEN, _EMPTY, _FULL, _OPEN = 0, 1, 2, 3
_GRAIN = 2048


def rounding_bounds(terms: tuple[np.ndarray, ...]) -> np.ndarray:
    """(N, 3) bounds on the rounding error of the sum of three terms, with room to spare (64 ulp)."""
    return np.sum([np.abs(t).max(-1) for t in terms], axis=0) * 1.5e-14


@kernel(inline="always")
def _span(a: float, b: float) -> tuple[float, float]:
    return 0.5 * (a + b), 0.5 * (b - a)


@kernel(inline="always")
def _bound_pixel(
    c: int, view: int, i0: int, i1: int, j0: int, j1: int, k0: int, k1: int, x: np.ndarray, y: np.ndarray,
    z: np.ndarray, dx: float, dy: float, dz: float, depth: float, nearest: float, slack: np.ndarray,
) -> tuple[float, float]:  # fmt: skip
    """Least and largest u (c = 0) or v (c = 1) of all points of a block."""
    # u - u_c = sum of (d0_a - u_c d2_a) s_a / depth with |s_a| <= 1, so this bound is tight to first order.
    ax, bx = _span(x[view, c, i0], x[view, c, i1])
    ay, by = _span(y[view, c, j0], y[view, c, j1])
    az, bz = _span(z[view, c, k0], z[view, c, k1])
    u = (ax + ay + az) / depth
    reach_px = abs(bx - u * dx) + abs(by - u * dy) + abs(bz - u * dz)
    half = (reach_px + slack[view, c] + 2 * abs(u) * slack[view, 2]) / nearest + 1e-9 + 1e-12 * abs(u)
    return u - half, u + half


@kernel(counted=False)
def _judge(
    view: int, i0: int, i1: int, j0: int, j1: int, k0: int, k1: int, x: np.ndarray, y: np.ndarray,
    z: np.ndarray, slack: np.ndarray, sizes: np.ndarray, starts: np.ndarray, tables: np.ndarray,
) -> int:  # fmt: skip
    """What one view says of all points with indices i0..i1, j0..j1, k0..k1 (inclusive)."""
    cx, dx = _span(x[view, 2, i0], x[view, 2, i1])
    cy, dy = _span(y[view, 2, j0], y[view, 2, j1])
    cz, dz = _span(z[view, 2, k0], z[view, 2, k1])
    depth = cx + cy + cz
    reach = abs(dx) + abs(dy) + abs(dz) + slack[view, 2]
    if depth + reach <= 0:
        return _UNSEEN
    nearest = depth - reach
    if nearest <= slack[view, 2]:
        return _OPEN
    width, height = sizes[view, 0], sizes[view, 1]
    u0, u1 = _bound_pixel(0, view, i0, i1, j0, j1, k0, k1, x, y, z, dx, dy, dz, depth, nearest, slack)
    if u1 < 0 or u0 >= width:
        return _UNSEEN
    v0, v1 = _bound_pixel(1, view, i0, i1, j0, j1, k0, k1, x, y, z, dx, dy, dz, depth, nearest, slack)
    if v1 < 0 or v0 >= height:
        return _UNSEEN
    if u0 < 0 or v0 < 0 or u1 >= width or v1 >= height:
        return _OPEN
    left, right, top, bottom = int(u0), int(u1) + 1, int(v0), int(v1) + 1
    stride, start = width + 1, starts[view]
    total = (
        tables[start + bottom * stride + right]
        - tables[start + top * stride + right]
        - tables[start + bottom * stride + left]
        + tables[start + top * stride + left]
    )
    if total == 0:
        return _EMPTY
    if total == (right - left) * (bottom - top):
        return _FULL
    return _OPEN


@kernel(counted=False)
def decide(table: np.ndarray, visible: int, occupied: int, unsettled: int) -> int:
    # A hit never harms; a miss helps K and harms agreement. So the best case is all hits, and in the worst
    # case either all unsettled views miss or none sees the voxel.
    if not table[visible + unsettled, occupied + unsettled]:
        return DROPPED
    if table[visible, occupied] and table[visible + unsettled, occupied]:
        return KEPT
    return MIXED


@kernel(counted=False)
def _classify(
    begin: int, end: int, blocks: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, slack: np.ndarray,
    sizes: np.ndarray, starts: np.ndarray, tables: np.ndarray, table: np.ndarray, states: np.ndarray,
) -> None:  # fmt: skip
    views = len(sizes)
    for b in range(begin, end):
        i, j, k = blocks[b, 0], blocks[b, 1], blocks[b, 2]
        visible, occupied, unsettled = 0, 0, 0
        for view in range(views):
            said = _judge(view, i, i + 1, j, j + 1, k, k + 1, x, y, z, slack, sizes, starts, tables)
            visible += said in (_EMPTY, _FULL)
            occupied += said == _FULL
            unsettled += said == _OPEN
            # Nothing the other views may say can save the block.
            rest = unsettled + views - 1 - view
            if not table[visible + rest, occupied + rest]:
                break
        states[b] = decide(table, visible, occupied, unsettled)


def classify_cells(
    silhouettes: Silhouettes, areas: Areas, grid: Grid, rule: KeepRule, cells: np.ndarray
) -> np.ndarray:
    """What the rule says of all points of whole cells, not of their centres alone.

    Args:
        areas: from `sum_areas`.
        cells: (M, 3) int64 indices of cells of `grid`.

    Returns:
        (M,) uint8: DROPPED or KEPT where it holds for every point of the cell, else MIXED.
    """
    terms = axis_terms(silhouettes.projections, [grid.planes(a) for a in range(3)])
    said = []
    for (_, its_rule), (tables, starts, _) in zip(silhouettes.ballots(rule), areas.of_ballots(), strict=True):
        states = np.empty(len(cells), np.uint8)
        inputs = (cells, *terms, rounding_bounds(terms), silhouettes.sizes, starts, tables, its_rule.table())
        parallel_for(_classify, len(cells), _GRAIN, *inputs, states)
        said.append(states)
    # Dropped by one is dropped, and mixed is all that is kept by one and not by the other.
    return np.where(np.minimum.reduce(said) == DROPPED, DROPPED, np.maximum.reduce(said)).astype(np.uint8)


@kernel(counted=False)
def _keep_centres(
    begin: int, end: int, cells: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, sizes: np.ndarray,
    offsets: np.ndarray, pixels: np.ndarray, table: np.ndarray, kept: np.ndarray,
) -> None:  # fmt: skip
    views = len(sizes)
    for b in range(begin, end):
        i, j, k = cells[b, 0], cells[b, 1], cells[b, 2]
        visible, occupied = 0, 0
        for view in range(views):
            depth = (x[view, 2, i] + y[view, 2, j]) + z[view, 2, k]
            if depth > 0:
                u = ((x[view, 0, i] + y[view, 0, j]) + z[view, 0, k]) / depth
                v = ((x[view, 1, i] + y[view, 1, j]) + z[view, 1, k]) / depth
                width, height = sizes[view, 0], sizes[view, 1]
                if u >= 0 and u < width and v >= 0 and v < height:
                    visible += 1
                    occupied += pixels[offsets[view] + np.int64(v) * width + np.int64(u)]
        kept[b] = table[visible, occupied]


def keep_centres(silhouettes: Silhouettes, grid: Grid, rule: KeepRule, cells: np.ndarray) -> np.ndarray:
    """(M,) bool: what the rule says of the centres of some cells (M, 3) of a grid."""
    terms = axis_terms(silhouettes.projections, [grid.centres(a) for a in range(3)])
    every = np.ones(len(cells), np.bool_)
    for ballot, its_rule in silhouettes.ballots(rule):
        kept = np.empty(len(cells), np.bool_)
        inputs = (cells, *terms, ballot.sizes, ballot.offsets, ballot.pixels, its_rule.table())
        parallel_for(_keep_centres, len(cells), _GRAIN, *inputs, kept)
        every &= kept
    return every
