"""Which Gaussians touch which tile of the image and which of its rows, nearest first."""

from __future__ import annotations

import math

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

TILE = 16
"""Edge of a tile in pixels."""

CHUNKS = 32
"""Parts of the Gaussians, by depth, that are sorted into tiles on their own."""


class Tiles:
    """Intersections of Gaussians and tiles, in two orders.

    By tile, front to back: those of tile t are `starts[t] .. starts[t + 1] - 1`; of each, `gaussians` names the
    Gaussian, `rows` its rows within the tile as 32 first + (one past the last), and `slots` its place in the
    other order. By Gaussian: slots `offsets[r] .. offsets[r + 1] - 1` are those of Gaussian `order[r]`.

    Args:
        splats: (N, RECORD), see projection.
        counts: (N,) int32, how many tiles each Gaussian meets.
        width, height: of the image.
    """

    def __init__(self, splats: np.ndarray, counts: np.ndarray, width: int, height: int):
        n = len(splats)
        self.columns, lines = -(-width // TILE), -(-height // TILE)
        self.count = self.columns * lines
        self.order = sort_by_depth(splats[:, 7])
        self.offsets = np.zeros(n + 1, np.int64)
        np.cumsum(counts[self.order], out=self.offsets[1:])
        total = int(self.offsets[-1])
        slot_tiles, slot_rows = np.empty(total, np.int32), np.empty(total, np.int16)
        cursors = np.zeros((CHUNKS, self.count), np.int32)
        size = max(-(-n // CHUNKS), 1)
        parallel_for(
            _list, CHUNKS, 1, size, self.order, splats, width, height, self.offsets, slot_tiles, slot_rows,
            cursors,
        )  # fmt: skip
        self.starts = np.zeros(self.count + 1, np.int32)
        _start(cursors, self.starts)
        self.gaussians, self.slots = np.empty(total, np.int32), np.empty(total, np.int32)
        self.rows = np.empty(total, np.int16)
        parallel_for(
            _fill, CHUNKS, 1, size, self.order, self.offsets, slot_tiles, slot_rows, cursors,
            self.gaussians, self.slots, self.rows,
        )  # fmt: skip


def sort_by_depth(depths: np.ndarray) -> np.ndarray:
    """Stable order (N,) int32 of depths (N,) >= 0, float32 or float64: a radix sort on the bits."""
    bits = np.ascontiguousarray(depths).view(np.uint32 if depths.dtype == np.float32 else np.uint64)
    return _radix_order(bits, 3 if depths.dtype == np.float32 else 6)


@kernel()
def _radix_order(keys, digits):
    n = len(keys)
    order, other = np.empty(n, np.int32), np.empty(n, np.int32)
    counts = np.empty(2049, np.int64)
    for i in range(n):
        order[i] = i
    for digit in range(digits):
        shift = 11 * digit
        for j in range(2049):
            counts[j] = 0
        for i in range(n):
            counts[((np.uint64(keys[i]) >> np.uint64(shift)) & np.uint64(2047)) + np.uint64(1)] += 1
        for j in range(2048):
            counts[j + 1] += counts[j]
        for i in range(n):
            bucket = (np.uint64(keys[order[i]]) >> np.uint64(shift)) & np.uint64(2047)
            other[counts[bucket]] = order[i]
            counts[bucket] += 1
        order, other = other, order
    return order


@kernel(fast=True)
def _columns(splats, i, width):
    """Columns of tiles that a Gaussian's box meets: first and one past the last."""
    real = splats.dtype.type
    u, extent, unit = splats[i, 8] - real(0.5), splats[i, 10], real(1 / TILE)
    first, last = np.floor((u - extent) * unit), np.floor((u + extent) * unit)
    return int(max(first, real(0))), int(min(last, real((width - 1) // TILE))) + 1


@kernel(fast=True)
def _lines(splats, i, column, height):
    """Pixel rows that the ellipse a dx^2 + 2 b dx dy + c dy^2 <= tau meets in a column of tiles: first and last.

    Its upper edge over x is concave, so the highest point in the column is at the ellipse's own highest point or
    the nearest x to it; the lowest likewise.
    """
    real = splats.dtype.type
    a, b, c, tau = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 12]
    half_width, half_height = splats[i, 10], splats[i, 11]
    left = real(column * TILE) + real(0.5) - splats[i, 8]
    right = left + real(TILE - 1)
    lean, tilt, squared = b / a * half_height, b / c, tau / c
    flat = squared / (half_width * half_width)
    high, low = min(max(-lean, left), right), min(max(lean, left), right)
    # A fiftieth of a pixel more: rounding must never cut what the test of alpha would keep.
    up = math.sqrt(max(squared - flat * high * high, real(0))) - tilt * high + real(0.02)
    down = math.sqrt(max(squared - flat * low * low, real(0))) + tilt * low + real(0.02)
    v = splats[i, 9] - real(0.5)
    first = int(np.ceil(max(v - down, real(0))))
    last = int(np.floor(max(min(v + up, real(height - 1)), real(-1))))
    return first, (last if left <= half_width and right >= -half_width else -1)


@kernel(fast=True)
def count_tiles(splats, i, width, height):
    """How many tiles of the image a Gaussian meets."""
    total = 0
    first, end = _columns(splats, i, width)
    for column in range(first, end):
        low, high = _lines(splats, i, column, height)
        if low <= high:
            total += high // TILE - low // TILE + 1
    return total


@kernel(error_model="numpy")
def _list(begin, end, size, order, splats, width, height, offsets, slot_tiles, slot_rows, counts):
    """Writes tile and rows of the slots of chunks begin .. end - 1, and how many slots of each lie in a tile."""
    columns = (width + TILE - 1) // TILE
    for chunk in range(begin, end):
        for rank in range(min(chunk * size, len(order)), min((chunk + 1) * size, len(order))):
            slot = offsets[rank]
            if offsets[rank + 1] == slot:
                continue
            first, end_column = _columns(splats, order[rank], width)
            for column in range(first, end_column):
                low, high = _lines(splats, order[rank], column, height)
                if low <= high:
                    for line in range(low // TILE, high // TILE + 1):
                        slot_tiles[slot] = line * columns + column
                        slot_rows[slot] = 32 * max(low - line * TILE, 0) + min(high - line * TILE + 1, TILE)
                        counts[chunk, line * columns + column] += 1
                        slot += 1


@kernel()
def _start(cursors, starts):
    """Turns counts (CHUNKS, tiles) into where each chunk's part of a tile begins; writes starts (tiles + 1,)."""
    at = 0
    for tile in range(len(starts) - 1):
        starts[tile] = at
        for chunk in range(len(cursors)):
            count = cursors[chunk, tile]
            cursors[chunk, tile] = at
            at += count
    starts[len(starts) - 1] = at


@kernel()
def _fill(begin, end, size, order, offsets, slot_tiles, slot_rows, cursors, gaussians, slots, rows):
    for chunk in range(begin, end):
        for rank in range(min(chunk * size, len(order)), min((chunk + 1) * size, len(order))):
            for slot in range(offsets[rank], offsets[rank + 1]):
                place = cursors[chunk, slot_tiles[slot]]
                cursors[chunk, slot_tiles[slot]] = place + 1
                gaussians[place] = order[rank]
                slots[place] = slot
                rows[place] = slot_rows[slot]
