"""Culling of a hull's pieces: one stays when it explains foreground that no better piece explains.

Every piece satisfies the keep rule, also those beside the object where a few views agree by chance. But the
silhouettes of such a stray lie inside those of the object, while a part of the object that broke off, however
thin, shows in some views beside everything else. A better piece is one that explains at least twice as much:
pieces of like size that could stand for each other all stay, since nobody can tell which of them is the object.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.carving.areas import Areas
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, axis_terms
from visdom_plugin.hull.grid.components import Pieces

_LEAST_PIXELS = 4
"""Working pixels of its own that a piece must explain in a view; a single voxel rarely covers more."""
_LEAST_SHARE = 0.2
"""Share of its silhouette in that view that these must be: strays reach over the rim of the object's silhouette
by a voxel or two."""
_LEAST_OF_MASK = 0.01
"""Two views must say so; or one, if these pixels are this share of its mask. The rim of a single mask that
disagrees with the others is explained by whatever lies there, mostly by strays near a camera."""
_BETTER = 2.0
"""How many times the foreground of a piece another one must explain, as a share of the masks, to be better."""
_LARGE, _FINE = 1 << 18, 384
"""Voxels from which a piece is drawn by a sample of its surface, in grids of more than so many along a side."""
_LARGEST_HALF = 16.0
"""Voxels right in front of a camera are drawn at most this large (half a side), in working pixels."""


class _Canvas(NamedTuple):
    """The masks in working pixels, one behind the other, each with an empty border of one pixel."""

    factors: np.ndarray
    """(N,) int64 pixels of the mask along a working pixel."""
    sizes: np.ndarray
    """(N, 2) int64 width and height, borders included."""
    offsets: np.ndarray
    """(N + 1,) int64 where each view starts."""
    foreground: np.ndarray
    """Flat bool: working pixels with any foreground."""


class _Drawn(NamedTuple):
    """The foreground that each piece covers."""

    starts: np.ndarray
    """(C, N + 1) int64 where the working pixels of a piece in a view start in `pixels`."""
    pixels: np.ndarray
    """Flat int32 indices into the canvas."""


def explaining_pieces(
    pieces: Pieces, occupancy: np.ndarray, grid: Grid, silhouettes: Silhouettes, rule: KeepRule, areas: Areas
) -> np.ndarray:
    """The pieces that explain foreground of their own.

    The silhouettes of pieces are drawn in working pixels about as large as a voxel there. A piece that stays
    explains the pixels it covers and their neighbours to those that explain half of it or less.

    Args:
        pieces: of `occupancy`, (X, Y, Z) bool, in `grid`.
        rule: what the pieces satisfy. Undecided cells seldom cover foreground in as many views as it asks for.
        areas: from `areas.sum_areas`.

    Returns:
        (C,) bool, at least one True where there are pieces.
    """
    if len(pieces.sizes) < 2:
        return np.ones(len(pieces.sizes), bool)
    # Pixels at which nothing is known ask for no piece.
    silhouettes, areas = silhouettes.demanding(), areas.known or areas
    thin = 2 if max(occupancy.shape) > _FINE else 1
    thin *= 2 if max(occupancy.shape) > 2 * _FINE else 1
    stretch = np.where(pieces.sizes >= _LARGE, thin, 1)
    runs, bounds = _shell(pieces, occupancy, stretch)
    largest = runs[slice(*bounds[pieces.sizes.argmax() :][:2])]
    middle = np.append(largest[:, :2] + 0.5, largest[:, 2:].mean(1, keepdims=True), 1).mean(0)
    focal = np.linalg.norm(silhouettes.projections[:, :2, :3], axis=-1).mean(-1)
    canvas = _lay_out(silhouettes, areas, focal * grid.voxel, grid.lower + middle * grid.voxel)
    drawn = _draw(runs, bounds, stretch, grid, silhouettes, canvas, focal)
    least_views = int(np.argmax(rule.table().any(0)))
    return _choose(drawn, canvas, least_views)


def _shell(pieces: Pieces, occupancy: np.ndarray, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Runs (R, 4) of x, y, first z and one past the last z of the voxels with a free face, sorted by piece; and
    where each piece's begin (C + 1,)."""
    order = np.argsort(pieces.labels, kind="stable")
    column = np.repeat(np.arange(len(pieces.column_starts) - 1), np.diff(pieces.column_starts))[order]
    whole = np.stack([*np.divmod(column, occupancy.shape[1]), pieces.begins[order], pieces.ends[order]], -1)
    coarse = stretch[pieces.labels[order]]
    grid, counts = occupancy.view(np.uint8), np.zeros(len(whole), np.int64)
    parallel_for(_list_shell, len(whole), 4096, whole, coarse, grid, counts, np.empty((0, 4), np.int64))
    starts = np.concatenate([[0], np.cumsum(counts)])
    runs = np.empty((starts[-1], 4), np.int64)
    parallel_for(_list_shell, len(whole), 4096, whole, coarse, grid, starts, runs)
    return runs, starts[np.searchsorted(pieces.labels[order], np.arange(len(pieces.sizes) + 1))]


@kernel(counted=False)
def _list_shell(
    begin: int, end: int, whole: np.ndarray, coarse: np.ndarray, grid: np.ndarray, starts: np.ndarray,
    runs: np.ndarray,
) -> None:  # fmt: skip
    """Counts in `starts`, or lists from there on in `runs` unless that is empty."""
    nx, ny, _ = grid.shape
    for r in range(begin, end):
        i, j, first, stop = whole[r, 0], whole[r, 1], whole[r, 2], whole[r, 3]
        rim = i == 0 or j == 0 or i == nx - 1 or j == ny - 1
        found = starts[r]
        before = False
        # Where i + 3 j + 5 k is a multiple of the square: evenly spread over faces of any direction. 13 is the
        # inverse of 5 modulo 16 and modulo 4.
        every = coarse[r] * coarse[r]
        for k in range(first + (-13 * (i + 3 * j) - first) % every, stop, every):
            free = rim or k == first or k == stop - 1
            if not free:
                free = not (grid[i - 1, j, k] & grid[i + 1, j, k] & grid[i, j - 1, k] & grid[i, j + 1, k])
            if free and not before:
                if len(runs):
                    runs[found, 0], runs[found, 1], runs[found, 2] = i, j, k
                found += 1
            if free and len(runs):
                runs[found - 1, 3] = k + 1
            before = free and every == 1
        if not len(runs):
            starts[r] = found


def _lay_out(silhouettes: Silhouettes, areas: Areas, edge_px: np.ndarray, about: np.ndarray) -> _Canvas:
    """Working pixels as large as a voxel at the point `about` (3,); `edge_px` (N,) is its edge at depth 1."""
    tables, starts, _ = areas
    depth = np.abs(silhouettes.projections[:, 2] @ np.append(about, 1.0))
    factors = np.clip(edge_px / np.maximum(depth, 1e-12), 1, silhouettes.sizes.min(1)).astype(np.int64)
    inner = -(-silhouettes.sizes // factors[:, None])
    offsets = np.concatenate([[0], np.cumsum((inner + 2).prod(1))])
    foreground = np.zeros(offsets[-1], bool)
    for view, size in enumerate(silhouettes.sizes):
        table = tables[starts[view] :][: (size + 1).prod()].reshape(size[1] + 1, size[0] + 1)
        columns, rows = (
            np.minimum(np.arange(n + 1) * factors[view], m) for n, m in zip(inner[view], size, strict=True)
        )
        sums = np.diff(np.diff(table[np.ix_(rows, columns)], axis=0), axis=1)
        foreground[offsets[view] : offsets[view + 1]] = np.pad(sums > 0, 1).reshape(-1)
    return _Canvas(factors, inner + 2, offsets, foreground)


@kernel()
def _trace(
    begin: int, end: int, runs: np.ndarray, bounds: np.ndarray, stretch: np.ndarray, x: np.ndarray,
    y: np.ndarray, z: np.ndarray, edge_px: np.ndarray, factors: np.ndarray, sizes: np.ndarray,
    offsets: np.ndarray, foreground: np.ndarray, starts: np.ndarray, pixels: np.ndarray,
) -> None:  # fmt: skip
    """Counts in `starts`, or lists from there on in `pixels` unless that is empty, what pieces cover in views."""
    for view in range(begin, end):
        width, height = sizes[view, 0], sizes[view, 1]  # a row costs a kernel more to take apart
        offset, scale = offsets[view], 1.0 / factors[view]
        last = np.empty(width * height, np.int32)
        for at in range(len(last)):
            last[at] = -1
        for piece in range(len(bounds) - 1):
            found = starts[piece, view]
            for r in range(bounds[piece], bounds[piece + 1]):
                i, j = runs[r, 0], runs[r, 1]
                for k in range(runs[r, 2], runs[r, 3]):
                    depth = x[view, 2, i] + y[view, 2, j] + z[view, 2, k]
                    if depth <= 0:
                        continue
                    closeness = scale / depth
                    u = (x[view, 0, i] + y[view, 0, j] + z[view, 0, k]) * closeness + 1
                    v = (x[view, 1, i] + y[view, 1, j] + z[view, 1, k]) * closeness + 1
                    half = min(0.5 * edge_px[view] * stretch[piece] * closeness, _LARGEST_HALF)
                    if u + half < 1 or v + half < 1 or u - half >= width - 1 or v - half >= height - 1:
                        continue
                    left, right = max(int(u - half), 1), min(int(u + half), width - 2)
                    for row in range(max(int(v - half), 1), min(int(v + half), height - 2) + 1):
                        for at in range(row * width + left, row * width + right + 1):
                            if last[at] != piece:
                                last[at] = piece
                                if foreground[offset + at]:
                                    if len(pixels):
                                        pixels[found] = offset + at
                                    found += 1
            if not len(pixels):
                starts[piece, view] = found


def _draw(
    runs: np.ndarray,
    bounds: np.ndarray,
    stretch: np.ndarray,
    grid: Grid,
    silhouettes: Silhouettes,
    canvas: _Canvas,
    focal: np.ndarray,
) -> _Drawn:
    terms = axis_terms(silhouettes.projections, [grid.centres(a) for a in range(3)])
    inputs = (runs, bounds, stretch, *terms, focal * grid.voxel, *canvas)
    views = len(silhouettes)
    counts = np.zeros((len(bounds) - 1, views), np.int64)
    parallel_for(_trace, views, 1, *inputs, counts, np.empty(0, np.int32))
    ends = np.cumsum(counts).reshape(counts.shape)
    starts = np.concatenate([ends[:, :1] - counts[:, :1], ends], 1)
    pixels = np.empty(counts.sum(), np.int32)
    parallel_for(_trace, views, 1, *inputs, starts, pixels)
    return _Drawn(starts, pixels)


def _choose(drawn: _Drawn, canvas: _Canvas, least_views: int) -> np.ndarray:
    totals = np.maximum(np.add.reduceat(canvas.foreground, canvas.offsets[:-1], dtype=np.int64), 1)
    counts = np.diff(drawn.starts, axis=1)
    shares = (counts / totals).sum(1)
    order = np.argsort(-shares, kind="stable")
    keep = np.zeros(len(shares), bool)
    keep[order[0]] = True
    explained = np.zeros(len(canvas.foreground), bool)
    better = 0
    for piece in order[1:]:
        if counts[piece].max() < _LEAST_PIXELS or np.count_nonzero(counts[piece]) < least_views:
            continue
        while shares[order[better]] >= _BETTER * shares[piece]:
            if keep[order[better]]:
                _explain(explained, drawn, canvas, order[better])
            better += 1
        views = [drawn.pixels[a:b] for a, b in itertools.pairwise(drawn.starts[piece])]
        fresh = np.array([len(pixels) - np.count_nonzero(explained[pixels]) for pixels in views])
        says = (fresh >= _LEAST_PIXELS) & (fresh >= _LEAST_SHARE * counts[piece])
        keep[piece] = says.sum() >= 2 or (says & (fresh >= _LEAST_OF_MASK * totals)).any()
    return keep


def _explain(explained: np.ndarray, drawn: _Drawn, canvas: _Canvas, piece: int) -> None:
    """Marks the pixels of a piece and their eight neighbours."""
    for width, (a, b) in zip(canvas.sizes[:, 0], itertools.pairwise(drawn.starts[piece]), strict=True):
        if a == b:
            continue
        low = int(drawn.pixels[a:b].min()) - width - 1
        near = np.zeros(int(drawn.pixels[a:b].max()) + width + 2 - low, bool)
        near[drawn.pixels[a:b] - low] = True
        for step in (1, width):
            grown = near.copy()
            grown[step:] |= near[:-step]
            grown[:-step] |= near[step:]
            near = grown
        explained[low : low + len(near)] |= near
