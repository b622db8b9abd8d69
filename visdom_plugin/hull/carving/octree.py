"""The exact hierarchical carve: whole blocks are judged through summed-area tables of the masks.

For a block of voxel centres each view is bounded: the centres project into a rectangle whose mask pixels are
counted with four look-ups. A view that sees all of them and finds only mask, or none, or that sees none of
them, is settled for the whole block; only unsettled views are looked at again in its eight children, all eight
at once. A block is done as soon as the rule gives the same answer whatever the unsettled views will say. Bounds
are widened by the rounding error of the projection, so the result equals the dense vote bit for bit.
"""

from __future__ import annotations

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.carving.areas import Areas, sum_areas
from visdom_plugin.hull.carving.cells import DROPPED, KEPT, decide, rounding_bounds
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, axis_terms

_TOP, _LEAF = 64, 4
"""Edges of the blocks that threads are handed, and of those whose voxels are judged one by one."""
_EIGHT = 8
# What a view says of a block, as numbers whose sum over the views counts those that see it, of these the ones that
# find only mask, and those that are not settled.
_BITS = 20
_UNSEEN, _EMPTY, _FULL, _OPEN = 0, 1, 1 | 1 << _BITS, 1 << 2 * _BITS


@kernel(inline="always")
def _halves(terms: np.ndarray, view: int, c: int, first: int, step: int) -> tuple[float, float, float]:
    """Middles of two neighbouring intervals of `step` centres, and half the longer one's length with its sign."""
    last = terms.shape[2] - 1
    a, b = terms[view, c, min(first, last)], terms[view, c, min(first + step - 1, last)]
    d, e = terms[view, c, min(first + step, last)], terms[view, c, min(first + 2 * step - 1, last)]
    return 0.5 * (a + b), 0.5 * (d + e), 0.5 * ((b - a) if abs(b - a) >= abs(e - d) else (e - d))


@kernel(error_model="numpy", counted=False)
def _judge_children(
    view: int, row: int, eight: int, i: int, j: int, k: int, step: int, x: np.ndarray, y: np.ndarray,
    z: np.ndarray, slack: np.ndarray, sizes: np.ndarray, starts: np.ndarray, tables: np.ndarray,
    room: np.ndarray, said: np.ndarray,
) -> None:  # fmt: skip
    """What one view says of all centres of each of the eight blocks of `step` voxels from (i, j, k) on.

    `eight` is 8, hidden from the compiler: what it knows to be eight it would unroll and not turn into vectors.
    room: (7, 8) to work in. Fills in said[row].
    """
    for c in range(3):
        x0, x1, room[3, c] = _halves(x, view, c, i, step)
        y0, y1, room[4, c] = _halves(y, view, c, j, step)
        z0, z1, room[5, c] = _halves(z, view, c, k, step)
        a, b, d, e = x0 + y0, x1 + y0, x0 + y1, x1 + y1
        room[c, 0], room[c, 1], room[c, 2], room[c, 3] = a + z0, b + z0, d + z0, e + z0
        room[c, 4], room[c, 5], room[c, 6], room[c, 7] = a + z1, b + z1, d + z1, e + z1
    ux, uy, uz = room[3, 0], room[4, 0], room[5, 0]
    vx, vy, vz = room[3, 1], room[4, 1], room[5, 1]
    dx, dy, dz = room[3, 2], room[4, 2], room[5, 2]
    slack_u, slack_v, slack_d = slack[view, 0], slack[view, 1], slack[view, 2]
    reach = abs(dx) + abs(dy) + abs(dz) + slack_d
    wide, high = float(sizes[view, 0]), float(sizes[view, 1])
    for m in range(eight):
        depth = room[2, m]
        ahead = depth - reach > slack_d
        nearest = depth - reach if ahead else 1.0
        u, v = room[0, m] / (depth if ahead else 1.0), room[1, m] / (depth if ahead else 1.0)
        # u of a point - u = sum of (ux - u dx) s / depth with |s| <= 1, so this bound is tight to first order.
        reach_u = abs(ux - u * dx) + abs(uy - u * dy) + abs(uz - u * dz)
        reach_v = abs(vx - v * dx) + abs(vy - v * dy) + abs(vz - v * dz)
        half_u = (reach_u + slack_u + 2 * abs(u) * slack_d) / nearest + 1e-9 + 1e-12 * abs(u)
        half_v = (reach_v + slack_v + 2 * abs(v) * slack_d) / nearest + 1e-9 + 1e-12 * abs(v)
        u0, u1, v0, v1 = u - half_u, u + half_u, v - half_v, v + half_v
        within = (u0 >= 0) & (v0 >= 0) & (u1 < wide) & (v1 < high) & ahead
        beside = ((u1 < 0) | (u0 >= wide) | (v1 < 0) | (v0 >= high)) & ahead
        unseen = (depth + reach <= 0) | beside
        # Below zero: outside the image, in whole or in part; and not seen at all.
        room[0, m], room[1, m] = u0 if within else -1.0, v0
        room[2, m], room[6, m] = -1.0 if unseen else u1, v1
    stride, start = sizes[view, 0] + 1, starts[view]
    for m in range(_EIGHT):
        if room[0, m] < 0:
            said[row, m] = _UNSEEN if room[2, m] == -1.0 else _OPEN
            continue
        left, right = int(room[0, m]), int(room[2, m]) + 1
        top, bottom = int(room[1, m]), int(room[6, m]) + 1
        above, below = start + top * stride, start + bottom * stride
        total = tables[below + right] - tables[above + right] - tables[below + left] + tables[above + left]
        mixed = _FULL if total == (right - left) * (bottom - top) else _OPEN
        said[row, m] = _EMPTY if total == 0 else mixed


@kernel(error_model="numpy", counted=False)
def _vote_leaf(
    i0: int, j0: int, k0: int, count: int, open_views: np.ndarray, settled: int, per_view: int, x: np.ndarray,
    y: np.ndarray, z: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, pixels: np.ndarray, rule: np.ndarray,
    room: np.ndarray, places: np.ndarray, votes: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Votes of the `_LEAF` ** 3 voxels from (i0, j0, k0) on.

    Counts are places in `rule`, a table of `per_view` numbers for each count of views that see a voxel; `settled`
    holds the settled views'. Beside the grid its last voxel is counted again.
    """
    nx, ny, nz = out.shape
    for m in range(len(votes)):
        votes[m] = settled
    for q in range(count):
        view = open_views[q]
        width, offset = sizes[view, 0], offsets[view]
        wide, high = float(width), float(sizes[view, 1])
        for c in range(3):
            z0, z1 = z[view, c, k0], z[view, c, min(k0 + 1, nz - 1)]
            z2, z3 = z[view, c, min(k0 + 2, nz - 1)], z[view, c, min(k0 + 3, nz - 1)]
            for i in range(_LEAF):
                for j in range(_LEAF):
                    # The dense vote adds in this order too: (x + y) + z.
                    row = x[view, c, min(i0 + i, nx - 1)] + y[view, c, min(j0 + j, ny - 1)]
                    m = (i * _LEAF + j) * _LEAF
                    room[c, m], room[c, m + 1] = row + z0, row + z1
                    room[c, m + 2], room[c, m + 3] = row + z2, row + z3
        for m in range(len(votes)):
            ahead = room[2, m] > 0
            depth = room[2, m] if ahead else 1.0
            u, v = room[0, m] / depth, room[1, m] / depth
            seen = ahead & (u >= 0) & (u < wide) & (v >= 0) & (v < high)
            place = np.int64(v if seen else 0.0) * width + np.int64(u if seen else 0.0)
            places[m] = place if seen else -1
        for m in range(len(votes)):
            seen = places[m] >= 0
            vote = per_view + pixels[offset + (places[m] if seen else 0)]
            votes[m] += vote if seen else 0
    any_kept = False
    for m in range(len(votes)):
        any_kept |= rule[votes[m]] != 0
    if any_kept:
        for i in range(i0, min(i0 + _LEAF, nx)):
            for j in range(j0, min(j0 + _LEAF, ny)):
                m = ((i - i0) * _LEAF + j - j0) * _LEAF - k0
                for k in range(k0, min(k0 + _LEAF, nz)):
                    out[i, j, k] = rule[votes[m + k]]


@kernel()
def _carve(
    begin: int, end: int, x: np.ndarray, y: np.ndarray, z: np.ndarray, slack: np.ndarray, sizes: np.ndarray,
    offsets: np.ndarray, pixels: np.ndarray, starts: np.ndarray, tables: np.ndarray, table: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    nx, ny, nz = out.shape
    views = len(sizes)
    by, bz = -(-ny // _TOP), -(-nz // _TOP)
    low, deepest = (1 << _BITS) - 1, 64
    rule, per_view = table.reshape(-1), views + 1
    # A stack of blocks: corner, half the edge, and the sum of what its settled views say; and its other views.
    blocks = np.empty((deepest, 5), np.int64)
    counts, open_views = np.empty(deepest, np.int64), np.empty((deepest, views), np.int64)
    here, still_open = np.empty(views, np.int64), np.empty(views + 1, np.int64)
    said, sums, room = np.empty((views, _EIGHT), np.int64), np.empty(_EIGHT, np.int64), np.empty((7, _EIGHT))
    voxels = _LEAF * _LEAF * _LEAF
    leaf, places, votes = np.empty((3, voxels)), np.empty(voxels, np.int64), np.empty(voxels, np.int64)
    for block in range(begin, end):
        blocks[0, 0], blocks[0, 1] = block // (by * bz) * _TOP, block // bz % by * _TOP
        blocks[0, 2], blocks[0, 3], blocks[0, 4] = block % bz * _TOP, _TOP // 2, 0
        counts[0] = views
        for view in range(views):
            open_views[0, view] = view
        height = 1
        while height > 0:
            height -= 1
            i, j, k, step = blocks[height, 0], blocks[height, 1], blocks[height, 2], blocks[height, 3]
            count = counts[height]
            for m in range(len(sums)):
                sums[m] = blocks[height, 4]
            for q in range(count):
                here[q] = open_views[height, q]
                _judge_children(
                    here[q], q, len(sums), i, j, k, step, x, y, z, slack, sizes, starts, tables, room, said
                )  # fmt: skip
                for m in range(len(sums)):
                    sums[m] += said[q, m]
            for m in range(_EIGHT):
                visible, occupied = sums[m] & low, sums[m] >> _BITS & low
                state = decide(table, visible, occupied, sums[m] >> 2 * _BITS)
                i0, j0, k0 = i + (m & 1) * step, j + (m >> 1 & 1) * step, k + (m >> 2) * step
                if state == DROPPED or i0 >= nx or j0 >= ny or k0 >= nz:
                    continue
                if state == KEPT:
                    for a in range(i0, min(i0 + step, nx)):
                        for b in range(j0, min(j0 + step, ny)):
                            for c in range(k0, min(k0 + step, nz)):
                                out[a, b, c] = 1
                    continue
                unsettled = (
                    0 * views
                )  # a mere 0 is a type of its own, and functions are compiled for it once more
                for q in range(count):
                    still_open[unsettled] = here[q]
                    unsettled += said[q, m] == _OPEN
                if step == _LEAF:
                    _vote_leaf(
                        i0, j0, k0, unsettled, still_open, visible * per_view + occupied, per_view, x, y, z,
                        sizes, offsets, pixels, rule, leaf, places, votes, out,
                    )  # fmt: skip
                    continue
                blocks[height, 0], blocks[height, 1], blocks[height, 2] = i0, j0, k0
                blocks[height, 3], blocks[height, 4] = step // 2, visible | occupied << _BITS
                counts[height] = unsettled
                for q in range(unsettled):
                    open_views[height, q] = still_open[q]
                height += 1


def block_carve(
    silhouettes: Silhouettes, grid: Grid, rule: KeepRule, areas: Areas | None = None
) -> np.ndarray:
    """The voxels that satisfy the rule, on the CPU, equal to `votes.dense_carve`.

    Work grows with the hull's surface. Pages of the result without a kept voxel are never touched.

    Args:
        areas: from `areas.sum_areas`, when it is at hand.

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
        parallel_for(_carve, blocks, 1, *terms, rounding_bounds(terms), *inputs, out)
        kept.append(out.view(bool))
    return kept[0] if len(kept) == 1 else kept[0] & kept[1]
