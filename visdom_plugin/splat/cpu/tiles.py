"""Which Gaussians touch which tile of the image and which of its rows, nearest first."""

from __future__ import annotations

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lanes import (
    WIDTH,
    any_of,
    ceil,
    floor,
    load,
    maximum,
    minimum,
    multiply_add,
    sqrt,
    store,
    transpose,
    where,
)
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


@kernel(error_model="numpy")
def scratch(like, count):
    """An array of `count` numbers that begins at a cache line: a vector across two takes twice as long."""
    room = np.empty(count + 16, like.dtype)
    start = (-room.ctypes.data % 64) // like.itemsize
    return room[start : start + count]


@kernel(fast=True)
def _columns(s, at, width):
    """Columns of tiles that the boxes of 16 Gaussians meet: first and last, by their fields from `at` on.

    Those not drawn meet none.
    """
    u, extent = load(s, at + 8 * WIDTH) - 0.5, load(s, at + 10 * WIDTH)
    first, last = floor((u - extent) * (1 / TILE)), floor((u + extent) * (1 / TILE))
    last = minimum(last, (width - 1) // TILE)
    return maximum(first, 0), where(load(s, at + 12 * WIDTH) > 0, last, -1)


@kernel(fast=True)
def _lines(s, at, column, height):
    """Pixel rows that the ellipses a dx^2 + 2 b dx dy + c dy^2 <= tau meet in a column of tiles: first and last.

    An ellipse's upper edge over x is concave, so the highest point in the column is at its own highest point or
    the nearest x to it; the lowest likewise.

    No product is added to anything but by multiply_add: two kernels must find the same rows.
    """
    a, b, c = load(s, at), load(s, at + WIDTH), load(s, at + 2 * WIDTH)
    half_width, half_height, tau = (
        load(s, at + 10 * WIDTH),
        load(s, at + 11 * WIDTH),
        load(s, at + 12 * WIDTH),
    )
    left = column * TILE - (load(s, at + 8 * WIDTH) - 0.5)
    right = left + (TILE - 1)
    lean, tilt, squared = b / a * half_height, b / c, tau / c
    flat = squared / (half_width * half_width)
    high, low = minimum(maximum(0 - lean, left), right), minimum(maximum(lean, left), right)
    up = sqrt(maximum((half_width - high) * (half_width + high) * flat, 0))
    down = sqrt(maximum((half_width - low) * (half_width + low) * flat, 0))
    # A fiftieth of a pixel more: rounding must never cut what the test of alpha would keep.
    up, down = multiply_add(0 - tilt, high, up) + 0.02, multiply_add(tilt, low, down) + 0.02
    v = load(s, at + 9 * WIDTH) - 0.5
    first, last = ceil(maximum(v - down, 0)), floor(minimum(v + up, height - 1))
    return first, where((left <= half_width) & (right >= 0 - half_width), last, -1)


@kernel(fast=True)
def count_tiles(s, at, width, height):
    """How many tiles of the image 16 Gaussians meet, by their fields from `at` on."""
    column, last = _columns(s, at, width)
    total = column * 0
    while any_of(column <= last):
        low, high = _lines(s, at, column, height)
        here = floor(high * (1 / TILE)) - floor(low * (1 / TILE)) + 1
        total = total + where((column <= last) & (low <= high), here, 0)
        column = column + 1
    return total


@kernel(error_model="numpy")
def _list(begin, end, size, order, splats, width, height, offsets, slot_tiles, slot_rows, counts):
    """Writes tile and rows of the slots of chunks begin .. end - 1, and how many slots of each lie in a tile."""
    columns = (width + TILE - 1) // TILE
    s = scratch(splats, WIDTH * 19)
    tops, bottoms, lines = WIDTH * 16, WIDTH * 17, WIDTH * 18
    rows = scratch(splats, WIDTH * WIDTH)
    slots = np.empty(WIDTH, np.int64)
    for chunk in range(begin, end):
        finish = min((chunk + 1) * size, len(order))
        for start in range(chunk * size, finish, WIDTH):
            count = min(finish - start, WIDTH)
            for lane in range(WIDTH):
                rank = start + min(lane, count - 1)
                store(rows, WIDTH * lane, load(splats, np.int64(order[rank]) * WIDTH))
                slots[lane] = offsets[rank]
            transpose(rows, 0, WIDTH, s, 0, WIDTH)
            column, last = _columns(s, 0, width)
            while any_of(column <= last):
                low, high = _lines(s, 0, column, height)
                store(s, tops, low)
                store(s, bottoms, where(column <= last, high, -1))
                store(s, lines, column)
                for lane in range(count):
                    top, bottom = int(s[tops + lane]), int(s[bottoms + lane])
                    if top <= bottom:
                        slot, tile = slots[lane], (top // TILE) * columns + int(s[lines + lane])
                        for line in range(top // TILE, bottom // TILE + 1):
                            slot_tiles[slot] = tile
                            slot_rows[slot] = 32 * max(top - line * TILE, 0) + min(
                                bottom - line * TILE + 1, TILE
                            )
                            counts[chunk, tile] += 1
                            tile += columns
                            slot += 1
                        slots[lane] = slot
                column = column + 1


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
