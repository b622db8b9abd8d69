"""The exact hierarchical carve: whole blocks are judged through summed-area tables of the masks.

For a block of voxel centres each view is bounded: the centres project into a rectangle whose mask pixels are
counted with four look-ups. A view that sees all of them and finds only mask, or none, or that sees none of
them, is settled for the whole block; only unsettled views are looked at again in its eight children. A block
is done as soon as the rule gives the same answer whatever the unsettled views will say. Bounds are widened by
the rounding error of the projection, so the result equals the dense vote bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, axis_terms

DROPPED, KEPT, MIXED = 0, 1, 2
_UNSEEN, _EMPTY, _FULL, _OPEN = 0, 1, 2, 3
_TOP, _LEAF = 32, 4
_GRAIN = 2048


class Areas(NamedTuple):
    """Summed-area tables of all masks, from `sum_areas`."""

    tables: np.ndarray
    """Flat int32; entry (r, c) of a view's table sums rows < r and columns < c."""
    starts: np.ndarray
    """(N,) int64 where each view's begins."""
    known: Areas | None = None
    """Those of what is known to be object, where there are pixels at which nothing is known."""

    def of_ballots(self) -> tuple[Areas, ...]:
        """One for each of `Silhouettes.ballots`."""
        return (self,) if self.known is None else (self, self.known)


@kernel()
def _sum_areas(
    begin: int, end: int, pixels: np.ndarray, sizes: np.ndarray, offsets: np.ndarray,
    table_offsets: np.ndarray, tables: np.ndarray,
) -> None:  # fmt: skip
    for view in range(begin, end):
        width, height = sizes[view]
        stride = width + 1
        table = tables[table_offsets[view] : table_offsets[view] + stride * (height + 1)]
        table[:stride] = 0
        for row in range(height):
            total = 0
            above, below = row * stride, (row + 1) * stride
            start = offsets[view] + row * width
            table[below] = 0
            for column in range(width):
                total += pixels[start + column]
                table[below + column + 1] = table[above + column + 1] + total


def sum_areas(silhouettes: Silhouettes) -> Areas:
    """Summed-area tables of all masks."""
    counts = (silhouettes.sizes + 1).prod(1)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    tables = np.empty(int(counts.sum()), np.int32)
    inputs = (silhouettes.pixels, silhouettes.sizes, silhouettes.offsets, starts)
    parallel_for(_sum_areas, len(silhouettes), 1, *inputs, tables)
    return Areas(tables, starts, None if silhouettes.unknown is None else sum_areas(silhouettes.demanding()))


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


@kernel()
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
    width, height = sizes[view]
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


@kernel()
def _decide(table: np.ndarray, visible: int, occupied: int, unsettled: int) -> int:
    # A hit never harms; a miss helps K and harms agreement. So the best case is all hits, and in the worst
    # case either all unsettled views miss or none sees the voxel.
    if not table[visible + unsettled, occupied + unsettled]:
        return DROPPED
    if table[visible, occupied] and table[visible + unsettled, occupied]:
        return KEPT
    return MIXED


@kernel()
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
        states[b] = _decide(table, visible, occupied, unsettled)


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


@kernel()
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
                width, height = sizes[view]
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


@kernel()
def _vote_leaf(
    i0: int, i1: int, j0: int, j1: int, k0: int, k1: int, count: int, open_views: np.ndarray, visible: int,
    occupied: int, x: np.ndarray, y: np.ndarray, z: np.ndarray, sizes: np.ndarray, offsets: np.ndarray,
    pixels: np.ndarray, table: np.ndarray, seen: np.ndarray, inside: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    n = (i1 - i0) * (j1 - j0) * (k1 - k0)
    for m in range(n):
        seen[m] = visible
        inside[m] = occupied
    for q in range(count):
        view = open_views[q]
        width, height = sizes[view]
        offset = offsets[view]
        m = 0
        for i in range(i0, i1):
            for j in range(j0, j1):
                # The dense vote adds in this order too: (x + y) + z.
                u_row = x[view, 0, i] + y[view, 0, j]
                v_row = x[view, 1, i] + y[view, 1, j]
                d_row = x[view, 2, i] + y[view, 2, j]
                for k in range(k0, k1):
                    depth = d_row + z[view, 2, k]
                    if depth > 0:
                        u = (u_row + z[view, 0, k]) / depth
                        v = (v_row + z[view, 1, k]) / depth
                        if u >= 0 and u < width and v >= 0 and v < height:
                            seen[m] += 1
                            inside[m] += pixels[offset + np.int64(v) * width + np.int64(u)]
                    m += 1
    m = 0
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                if table[seen[m], inside[m]]:
                    out[i, j, k] = 1
                m += 1


@kernel()
def _carve(
    begin: int, end: int, x: np.ndarray, y: np.ndarray, z: np.ndarray, slack: np.ndarray, sizes: np.ndarray,
    offsets: np.ndarray, pixels: np.ndarray, starts: np.ndarray, tables: np.ndarray, table: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    nx, ny, nz = out.shape
    views = len(sizes)
    by, bz = -(-ny // _TOP), -(-nz // _TOP)
    deepest = 64
    corner = np.empty((deepest, 3), np.int64)
    counts = np.empty((deepest, 4), np.int64)
    open_views = np.empty((deepest, views), np.int64)
    still_open = np.empty(views, np.int64)
    seen = np.empty(_LEAF * _LEAF * _LEAF, np.int64)
    inside = np.empty(_LEAF * _LEAF * _LEAF, np.int64)
    for block in range(begin, end):
        corner[0, 0] = block // (by * bz) * _TOP
        corner[0, 1] = block // bz % by * _TOP
        corner[0, 2] = block % bz * _TOP
        counts[0, 0], counts[0, 1], counts[0, 2], counts[0, 3] = _TOP, 0, 0, views
        for view in range(views):
            open_views[0, view] = view
        height = 1
        while height > 0:
            height -= 1
            i0, j0, k0 = corner[height, 0], corner[height, 1], corner[height, 2]
            size, visible, occupied = counts[height, 0], counts[height, 1], counts[height, 2]
            i1, j1, k1 = min(i0 + size, nx), min(j0 + size, ny), min(k0 + size, nz)
            count = 0 * views  # a mere 0 is a type of its own, and functions are compiled for it once more
            for q in range(counts[height, 3]):
                view = open_views[height, q]
                said = _judge(view, i0, i1 - 1, j0, j1 - 1, k0, k1 - 1, x, y, z, slack, sizes, starts, tables)
                if said == _OPEN:
                    still_open[count] = view
                    count += 1
                elif said == _FULL:
                    visible += 1
                    occupied += 1
                elif said == _EMPTY:
                    visible += 1
            state = _decide(table, visible, occupied, count)
            if state == DROPPED:
                continue
            if state == KEPT:
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        out[i, j, k0:k1] = 1
                continue
            if size <= _LEAF:
                _vote_leaf(
                    i0, i1, j0, j1, k0, k1, count, still_open, visible, occupied,
                    x, y, z, sizes, offsets, pixels, table, seen, inside, out,
                )  # fmt: skip
                continue
            step = size // 2
            for child in range(8):
                ci, cj, ck = (
                    i0 + (child & 1) * step,
                    j0 + (child >> 1 & 1) * step,
                    k0 + (child >> 2) * step,
                )
                if ci >= nx or cj >= ny or ck >= nz:
                    continue
                corner[height, 0], corner[height, 1], corner[height, 2] = ci, cj, ck
                counts[height, 0], counts[height, 1] = step, visible
                counts[height, 2], counts[height, 3] = occupied, count
                for q in range(count):
                    open_views[height, q] = still_open[q]
                height += 1


def block_carve(
    silhouettes: Silhouettes, grid: Grid, rule: KeepRule, areas: Areas | None = None
) -> np.ndarray:
    """The voxels that satisfy the rule, on the CPU, equal to `votes.dense_carve`.

    Work grows with the hull's surface. Pages of the result without a kept voxel are never touched.

    Args:
        areas: from `sum_areas`, when it is at hand.

    Returns:
        (X, Y, Z) bool.
    """
    terms = axis_terms(silhouettes.projections, [grid.centres(a) for a in range(3)])
    areas = sum_areas(silhouettes) if areas is None else areas
    blocks = int(np.prod([-(-n // _TOP) for n in grid.shape]))
    kept = []
    for (ballot, its_rule), (tables, starts, _) in zip(
        silhouettes.ballots(rule), areas.of_ballots(), strict=True
    ):
        out = np.zeros(grid.shape, np.uint8)
        inputs = (ballot.sizes, ballot.offsets, ballot.pixels, starts, tables, its_rule.table())
        parallel_for(_carve, blocks, 4, *terms, rounding_bounds(terms), *inputs, out)
        kept.append(out.view(bool))
    return kept[0] if len(kept) == 1 else kept[0] & kept[1]
