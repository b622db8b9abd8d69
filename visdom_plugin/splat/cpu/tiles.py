"""Which Gaussians touch which tile of the image, nearest first."""

from __future__ import annotations

import math

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

TILE = 16
"""Edge of a tile in pixels."""


class Tiles:
    """Intersections of Gaussians and tiles, in two orders.

    By tile, front to back: those of tile t are `starts[t] .. starts[t + 1] - 1`, and `gaussians` names them.
    By Gaussian: slots `offsets[i] .. offsets[i + 1] - 1`; `slot_tiles` names the tile of a slot and `slot_places`
    its index in the order by tile.
    """

    def __init__(self, means2d: np.ndarray, splats: np.ndarray, extents: np.ndarray, width: int, height: int):
        n = len(means2d)
        self.columns, self.rows = -(-width // TILE), -(-height // TILE)
        self.count = self.columns * self.rows
        self.offsets = np.zeros(n + 1, np.int64)
        shape = (means2d, splats, extents, self.columns, self.rows)
        parallel_for(_count, n, 2048, *shape, self.offsets)
        np.cumsum(self.offsets, out=self.offsets)
        total = int(self.offsets[-1])
        self.slot_tiles = np.empty(total, np.int32)
        parallel_for(_list, n, 2048, *shape, self.offsets, self.slot_tiles)
        self.starts = np.zeros(self.count + 1, np.int64)
        self.gaussians = np.empty(total, np.int32)
        self.slot_places = np.empty(total, np.int64)
        order = sort_by_depth(splats[:, 7])
        _fill(order, self.offsets, self.slot_tiles, self.starts, self.gaussians, self.slot_places)


def sort_by_depth(depths: np.ndarray) -> np.ndarray:
    """Stable order (N,) int64 of depths (N,) >= 0, float32 or float64: a radix sort on the bits."""
    bits = np.ascontiguousarray(depths).view(np.uint32 if depths.dtype == np.float32 else np.uint64)
    return _radix_order(bits.astype(np.uint64), 3 if depths.dtype == np.float32 else 6)


@kernel()
def _radix_order(keys, digits):
    n = len(keys)
    order, other = np.arange(n), np.empty(n, np.int64)
    counts = np.empty(2049, np.int64)
    for digit in range(digits):
        shift = np.uint64(11 * digit)
        counts[:] = 0
        for i in range(n):
            counts[np.int64((keys[i] >> shift) & np.uint64(2047)) + 1] += 1
        for j in range(2048):
            counts[j + 1] += counts[j]
        for i in range(n):
            bucket = np.int64((keys[order[i]] >> shift) & np.uint64(2047))
            other[counts[bucket]] = order[i]
            counts[bucket] += 1
        order, other = other, order
    return order


@kernel(error_model="numpy")
def _box(u, v, extent, columns, rows):
    """Tiles whose pixel centres the Gaussian's box may reach: first and one past the last, in x and y."""
    x0 = math.floor((u - extent[0] - 0.5) / TILE)
    x1 = math.floor((u + extent[0] - 0.5) / TILE) + 1
    y0 = math.floor((v - extent[1] - 0.5) / TILE)
    y1 = math.floor((v + extent[1] - 0.5) / TILE) + 1
    return int(max(x0, 0)), int(min(x1, columns)), int(max(y0, 0)), int(min(y1, rows))


@kernel(error_model="numpy")
def _meets(u, v, a, b, c, tau, column, row):
    """Whether the ellipse a x^2 + 2 b x y + c y^2 <= tau about (u, v) reaches the tile's pixel centres."""
    real = type(u)
    left, top = real(column * TILE) + real(0.5) - u, real(row * TILE) + real(0.5) - v
    right, bottom = left + real(TILE - 1), top + real(TILE - 1)
    x, y = min(max(real(0), left), right), min(max(real(0), top), bottom)  # the tile's point nearest to it
    if x == 0 and y == 0:
        return True
    # The smallest value lies on an edge that faces the centre: one variable is fixed, the other free.
    best = real(np.inf)
    if x != 0:
        free = min(max(-b * x / c, top), bottom)
        best = a * x * x + real(2) * b * x * free + c * free * free
    if y != 0:
        free = min(max(-b * y / a, left), right)
        best = min(best, a * free * free + real(2) * b * free * y + c * y * y)
    return best <= tau


@kernel(error_model="numpy")
def _count(begin, end, means2d, splats, extents, columns, rows, counts):
    for i in range(begin, end):
        total = 0
        tau = extents[i, 2]
        if tau > 0:
            u, v, a, b, c = means2d[i, 0], means2d[i, 1], splats[i, 0], splats[i, 1], splats[i, 2]
            x0, x1, y0, y1 = _box(u, v, extents[i], columns, rows)
            for row in range(y0, y1):
                for column in range(x0, x1):
                    if _meets(u, v, a, b, c, tau, column, row):
                        total += 1
        counts[i + 1] = total


@kernel(error_model="numpy")
def _list(begin, end, means2d, splats, extents, columns, rows, offsets, slot_tiles):
    for i in range(begin, end):
        slot = offsets[i]
        if offsets[i + 1] == slot:
            continue
        tau = extents[i, 2]
        u, v, a, b, c = means2d[i, 0], means2d[i, 1], splats[i, 0], splats[i, 1], splats[i, 2]
        x0, x1, y0, y1 = _box(u, v, extents[i], columns, rows)
        for row in range(y0, y1):
            for column in range(x0, x1):
                if _meets(u, v, a, b, c, tau, column, row):
                    slot_tiles[slot] = row * columns + column
                    slot += 1


@kernel()
def _fill(order, offsets, slot_tiles, starts, gaussians, slot_places):
    for slot in range(len(slot_tiles)):
        starts[slot_tiles[slot] + 1] += 1
    for tile in range(len(starts) - 1):
        starts[tile + 1] += starts[tile]
    cursor = starts.copy()
    for i in order:
        for slot in range(offsets[i], offsets[i + 1]):
            tile = slot_tiles[slot]
            gaussians[cursor[tile]] = i
            slot_places[slot] = cursor[tile]
            cursor[tile] += 1
