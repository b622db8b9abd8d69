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
"""Parts of the Gaussians that are sorted by depth on their own, and parts by depth that are sorted into tiles."""
SAMPLES = 8
"""Depths of a chunk, of those by which the parts by depth are chosen."""


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
        bits = splats.view(np.uint32 if splats.dtype == np.float32 else np.uint64)
        size = max(-(-n // CHUNKS), 1)
        own, keys = np.empty(n, np.int32), np.empty(n, bits.dtype)
        ahead, totals = np.empty(n, np.int64), np.empty(CHUNKS, np.int64)
        parallel_for(_sort_chunks, CHUNKS, 1, size, bits, counts, own, keys, ahead, totals)
        total = int(totals.sum())
        self.order, self.offsets = np.empty(n, np.int32), np.empty(n + 1, np.int64)
        self.offsets[n] = total
        slot_tiles, slot_rows = np.empty(total, np.int32), np.empty(total, np.int16)
        cursors, ranks = np.empty((CHUNKS, self.count), np.int32), np.empty(CHUNKS + 1, np.int64)
        ranks[CHUNKS] = n
        parallel_for(
            _list, CHUNKS, 1, size, own, keys, ahead, totals, _bounds(keys, size), counts, splats, width, height,
            self.order, self.offsets, ranks, slot_tiles, slot_rows, cursors,
        )  # fmt: skip
        self.starts = np.empty(self.count + 1, np.int32)
        _start(cursors, self.starts)
        self.gaussians, self.slots = np.empty(total, np.int32), np.empty(total, np.int32)
        self.rows = np.empty(total, np.int16)
        parallel_for(
            _fill, CHUNKS, 1, ranks, self.order, self.offsets, slot_tiles, slot_rows, cursors,
            self.gaussians, self.slots, self.rows,
        )  # fmt: skip


def _bounds(keys: np.ndarray, size: int) -> np.ndarray:
    """Keys (CHUNKS + 1,) between which lie parts of about as many Gaussians each; keys are sorted in chunks.

    What is not drawn has the key 0 and a part of its own. No result depends on the bounds.
    """
    samples = keys[:: max(size // SAMPLES, 1)].copy()
    samples.sort()
    samples = samples[samples.searchsorted(1) :]
    bounds = np.empty(CHUNKS + 1, keys.dtype)
    bounds[0], bounds[-1] = 0, np.iinfo(keys.dtype).max
    bounds[1:-1] = 1
    if len(samples):
        bounds[2:-1] = samples[_WITHIN * len(samples) // (CHUNKS - 1)]
    return bounds


_WITHIN = np.arange(1, CHUNKS - 1)


@kernel()
def _sort(keys, order):
    """Sorts both arrays by the keys, stably: a radix sort by bytes.

    Keys are bits of numbers >= 0. Bytes in which all but those of 0 agree are left out.
    """
    n = len(keys)
    low, high = ~np.uint64(0), np.uint64(0)  # one less than the least above 0, and the largest
    for i in range(n):
        high = max(high, np.uint64(keys[i]))
        low = min(low, np.uint64(keys[i]) + ~np.uint64(0)) if keys[i] else low
    a, names, b, moved = keys, order, np.empty_like(keys), np.empty_like(order)
    places = np.empty(256, np.int64)
    shift, left = np.uint64(0), high - low if high else np.uint64(0)
    while left:
        for j in range(256):
            places[j] = 0
        for i in range(n):
            places[_byte(a[i], low, shift)] += 1
        at = 0
        for j in range(256):
            count = places[j]
            places[j] = at
            at += count
        for i in range(n):
            byte = _byte(a[i], low, shift)
            place = places[byte]
            places[byte] = place + 1
            b[place] = a[i]
            moved[place] = names[i]
        a, names, b, moved = b, moved, a, names
        shift += np.uint64(8)
        left >>= np.uint64(8)
    # After an odd number of bytes the result is in the other arrays.
    if shift & np.uint64(8):
        for i in range(n):
            keys[i] = a[i]
            order[i] = names[i]


@kernel(inline="always")
def _byte(key, low, shift):
    """Of what a key is more than `low`; of nothing for the key 0."""
    return ((np.uint64(key) - low) * np.uint64(key > 0) >> shift) & np.uint64(255)


@kernel()
def _sort_chunks(begin, end, size, bits, counts, own, keys, ahead, totals):
    """Sorts the Gaussians of chunks begin .. end - 1 by depth: writes which they are and their keys.

    `ahead` (N,) are the tiles that those before one in its chunk meet, `totals` (CHUNKS,) those of a chunk.
    """
    n = len(own)
    for chunk in range(begin, end):
        first, last = min(chunk * size, n), min((chunk + 1) * size, n)
        for i in range(first, last):
            own[i], keys[i] = i, bits[i, 7]
        _sort(keys[first:last], own[first:last])
        total = 0
        for i in range(first, last):
            ahead[i] = total
            total += counts[own[i]]
        totals[chunk] = total


@kernel()
def _first_from(keys, first, last, key):
    """The first place of sorted keys that holds no smaller one than `key`."""
    while first < last:
        middle = (first + last) // 2
        if keys[middle] < key:
            first = middle + 1
        else:
            last = middle
    return first


@kernel()
def _merge(part, size, own, keys, ahead, totals, bounds, counts, order, offsets, ranks):
    """Sorts a part by depth, of what all chunks have of it, and finds its slots; returns its ranks."""
    n = len(own)
    starts, ends = np.empty(CHUNKS, np.int64), np.empty(CHUNKS, np.int64)
    rank, slot, count = 0, 0, 0
    for chunk in range(CHUNKS):
        first, last = min(chunk * size, n), min((chunk + 1) * size, n)
        starts[chunk] = _first_from(keys, first, last, bounds[part])
        ends[chunk] = _first_from(keys, starts[chunk], last, bounds[part + 1])
        rank += starts[chunk] - first
        slot += ahead[starts[chunk]] if starts[chunk] < last else totals[chunk]
        count += ends[chunk] - starts[chunk]
    depths, at = np.empty(count, keys.dtype), 0
    for chunk in range(CHUNKS):
        for i in range(starts[chunk], ends[chunk]):
            depths[at], order[rank + at] = keys[i], own[i]
            at += 1
    _sort(depths, order[rank : rank + count])
    for i in range(rank, rank + count):
        offsets[i] = slot
        slot += counts[order[i]]
    ranks[part] = rank
    return rank, rank + count


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
def _list(
    begin, end, size, own, keys, ahead, totals, bounds, met, splats, width, height,
    order, offsets, ranks, slot_tiles, slot_rows, counts,
):  # fmt: skip
    """Sorts parts begin .. end - 1; writes tile and rows of their slots, and how many of each lie in a tile."""
    columns = (width + TILE - 1) // TILE
    s = scratch(splats, WIDTH * 19)
    tops, bottoms, lines = WIDTH * 16, WIDTH * 17, WIDTH * 18
    rows = scratch(splats, WIDTH * WIDTH)
    slots = np.empty(WIDTH, np.int64)
    for chunk in range(begin, end):
        for tile in range(counts.shape[1]):
            counts[chunk, tile] = 0
        rank, finish = _merge(chunk, size, own, keys, ahead, totals, bounds, met, order, offsets, ranks)
        for start in range(rank, finish, WIDTH):
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
def _fill(begin, end, ranks, order, offsets, slot_tiles, slot_rows, cursors, gaussians, slots, rows):
    for chunk in range(begin, end):
        for rank in range(ranks[chunk], ranks[chunk + 1]):
            for slot in range(offsets[rank], offsets[rank + 1]):
                place = cursors[chunk, slot_tiles[slot]]
                cursors[chunk, slot_tiles[slot]] = place + 1
                gaussians[place] = order[rank]
                slots[place] = slot
                rows[place] = slot_rows[slot]
