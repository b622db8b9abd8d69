"""Alpha blending tile by tile, front to back, and its gradient, back to front.

Per pixel and Gaussian: alpha = min(0.999, opacity exp(-sigma)), skipped below 1/255; the first Gaussian that
would bring the transmittance to 1e-4 or less ends the pixel and is not drawn (gsplat, 3DGS).

A row of a tile is one vector. A row's numbers lie in one scratch array, PLANES vectors a row: what a pixel holds.
"""

from __future__ import annotations

import numpy as np

from visdom_plugin.compute import lanes
from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lane_math import exp2
from visdom_plugin.compute.lanes import any_of, fill, load, minimum, store, where
from visdom_plugin.splat.cpu.projection import LOG2_ALPHA_MIN, LOG2_E, RECORD
from visdom_plugin.splat.cpu.tiles import TILE, scratch

assert TILE == lanes.WIDTH == RECORD

ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4

SUMS = 16
"""Numbers per intersection, the last six unused. With g the loss's gradient by sigma at a pixel, and dx, dy from
the pixel to the mean: sums of g, g dx, g dy, g dx^2, g dx dy, g dy^2, gradients of red, green, blue, z."""

# T is the transmittance, negated once a pixel has ended; END the place in the tile of the Gaussian that ended it.
# Then, going forward, the colour and depth summed; going backward, their gradients, and the part of the loss that
# lies behind.
T, END, RED, GREEN, BLUE, Z, BEHIND, PLANES = (TILE * plane for plane in range(8))
BATCH = 16
"""Gaussians that are fetched at once, and after which rows that have ended are looked for."""


@kernel(error_model="numpy")
def _fetch(k, count, gaussians, splats, batch):
    """Copies the records of the next Gaussians next to each other: their cache misses overlap."""
    for j in range(count):
        store(batch, j * RECORD, load(splats, np.int64(gaussians[k + j]) * RECORD))


@kernel(fast=True)
def _along_row(batch, g, xs, y):
    """Of the Gaussian at g: dx, dy to the pixels of row y; the rest of log2(alpha) = a_dx - dy (c dy + b_dx)."""
    real = batch.dtype.type
    half = real(0.5)
    dx, dy = batch[g + 8] - xs, fill(batch[g + 9] - (real(y) + half))
    a, b, c = real(0.5 * LOG2_E) * batch[g], real(LOG2_E) * batch[g + 1], real(0.5 * LOG2_E) * batch[g + 2]
    return dx, dy, batch[g + 13] - a * dx * dx, b * dx, fill(c)


@kernel(error_model="numpy")
def blend(
    begin, end, starts, gaussians, rows, columns, splats, background,
    rgb, alpha, depth, transmittance, ends, reached,
):  # fmt: skip
    """Draws tiles begin .. end - 1.

    Writes rgb (H, W, 3) with the background in it, alpha (H, W), depth (H, W) divided by alpha, transmittance
    (H, W), ends (H, W): the place within its tile of the Gaussian that ended a pixel, or infinity, and reached
    (tiles,): how many of a tile's Gaussians were looked at.
    """
    height, width = alpha.shape
    real = alpha.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    s, batch = scratch(alpha, TILE * PLANES), scratch(alpha, BATCH * RECORD)
    nothing = fill(zero)
    for tile in range(begin, end):
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        xs = lanes.count_up(real(left) + half)
        for p in range(0, TILE * PLANES, PLANES):
            store(s, p + T, where(xs < real(width if top + p // PLANES < height else 0), fill(one), -one))
            store(s, p + END, fill(real(np.inf)))
            for plane in range(RED, BEHIND, TILE):
                store(s, p + plane, nothing)
        start, finish = np.int64(starts[tile]), np.int64(starts[tile + 1])
        k = start
        while k < finish:
            first_row, end_row = TILE, 0
            for row in range(TILE):
                if any_of(load(s, row * PLANES + T) > zero):
                    first_row, end_row = min(first_row, row), row + 1
            if end_row == 0:
                break
            count = min(BATCH, finish - k)
            _fetch(k, count, gaussians, splats, batch)
            for j in range(count):
                r0, r1 = max(rows[k + j] // 32, first_row), min(rows[k + j] % 32, end_row)
                g = j * RECORD
                _, dy, a_dx, b_dx, c = _along_row(batch, g, xs, top + r0)
                red, green, blue, z = batch[g + 4], batch[g + 5], batch[g + 6], batch[g + 7]
                place = real(k + j - start)
                for p in range(r0 * PLANES, r1 * PLANES, PLANES):
                    power = a_dx - dy * (c * dy + b_dx)
                    dy = dy - one
                    passes = power >= real(LOG2_ALPHA_MIN)
                    opacity = minimum(exp2(power), real(ALPHA_MAX))  # of any power: what is below is dropped
                    t = load(s, p + T)
                    weight = opacity * t
                    left_over = t - weight
                    closes = passes & (left_over <= real(TRANSMITTANCE_MIN)) & (t > zero)
                    weight = where(passes & (left_over > real(TRANSMITTANCE_MIN)), weight, nothing)
                    store(s, p + T, where(closes, zero - t, t - weight))
                    store(s, p + END, where(closes, place, load(s, p + END)))
                    store(s, p + RED, load(s, p + RED) + weight * red)
                    store(s, p + GREEN, load(s, p + GREEN) + weight * green)
                    store(s, p + BLUE, load(s, p + BLUE) + weight * blue)
                    store(s, p + Z, load(s, p + Z) + weight * z)
            k += count
        reached[tile] = k - start
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                p = (y - top) * PLANES + x - left
                t = abs(s[p + T])
                transmittance[y, x] = t
                alpha[y, x] = one - t
                rgb[y, x, 0] = s[p + RED] + t * background[0]
                rgb[y, x, 1] = s[p + GREEN] + t * background[1]
                rgb[y, x, 2] = s[p + BLUE] + t * background[2]
                depth[y, x] = s[p + Z] / (one - t) if t < one else zero
                ends[y, x] = s[p + END]


@kernel(error_model="numpy")
def blend_backward(
    begin, end, starts, gaussians, rows, slots, columns, splats, background,
    alpha, depth, transmittance, ends, reached, g_rgb, g_alpha, g_depth, sums,
):  # fmt: skip
    """Writes the sums (SUMS,) of each intersection of tiles begin .. end - 1, at its slot.

    Going back to front, T becomes the transmittance in front of a Gaussian and BEHIND the loss's gradient carried
    by all that lies behind. With q the gradient along its colour and depth, dL/dalpha is
    T q - BEHIND / (1 - alpha). Where g_alpha or g_depth is empty it is zero.
    """
    height, width = alpha.shape
    real = alpha.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    s, batch = scratch(alpha, TILE * PLANES), scratch(alpha, BATCH * RECORD)
    nothing = fill(zero)
    for tile in range(begin, end):
        start = np.int64(starts[tile])
        finish = start + reached[tile]
        for k in range(finish, starts[tile + 1]):
            store(sums, np.int64(slots[k]) * SUMS, nothing)
        if start == finish:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        xs = lanes.count_up(real(left) + half)
        for p in range(0, TILE * PLANES, TILE):
            store(s, p, nothing)
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                p = (y - top) * PLANES + x - left
                t, opaque, gz = transmittance[y, x], alpha[y, x], zero
                s[p + T], s[p + END] = t, ends[y, x]
                # depth = z summed / alpha, and alpha = 1 - T; T also carries the background.
                by_t = -g_alpha[y, x] if g_alpha.size else zero
                if g_depth.size and opaque > zero:
                    gz = g_depth[y, x] / opaque
                    by_t += gz * depth[y, x]
                for channel in range(3):
                    by_t += g_rgb[y, x, channel] * background[channel]
                s[p + RED], s[p + GREEN], s[p + BLUE] = g_rgb[y, x, 0], g_rgb[y, x, 1], g_rgb[y, x, 2]
                s[p + Z], s[p + BEHIND] = gz, t * by_t
        k = finish
        while k > start:
            count = min(BATCH, k - start)
            k -= count
            _fetch(k, count, gaussians, splats, batch)
            for j in range(count - 1, -1, -1):
                r0, r1 = rows[k + j] // 32, rows[k + j] % 32
                g = j * RECORD
                dx, dy, a_dx, b_dx, c = _along_row(batch, g, xs, top + r0)
                red, green, blue, z = batch[g + 4], batch[g + 5], batch[g + 6], batch[g + 7]
                place = real(k + j - start)
                s0, sy, syy, s_red, s_green, s_blue, s_z = (
                    nothing, nothing, nothing, nothing, nothing, nothing, nothing,
                )  # fmt: skip
                for p in range(r0 * PLANES, r1 * PLANES, PLANES):
                    power = a_dx - dy * (c * dy + b_dx)
                    drawn = (power >= real(LOG2_ALPHA_MIN)) & (load(s, p + END) > place)
                    full = exp2(power)  # of any power: what is not drawn is dropped
                    opacity = minimum(full, real(ALPHA_MAX))
                    share = where(drawn, opacity / (one - opacity), nothing)
                    t, behind = load(s, p + T), load(s, p + BEHIND)
                    weight = share * t  # opacity times what comes to the Gaussian, t / (1 - opacity)
                    g_red, g_green, g_blue, g_z = (
                        load(s, p + RED), load(s, p + GREEN), load(s, p + BLUE), load(s, p + Z),
                    )  # fmt: skip
                    q = g_red * red + g_green * green + g_blue * blue + g_z * z
                    g_sigma = where(full <= real(ALPHA_MAX), share * (behind - t * q), nothing)
                    store(s, p + T, t + weight)
                    store(s, p + BEHIND, behind + weight * q)
                    s_red, s_green = s_red + weight * g_red, s_green + weight * g_green
                    s_blue, s_z = s_blue + weight * g_blue, s_z + weight * g_z
                    by_y = g_sigma * dy
                    s0, sy, syy = s0 + g_sigma, sy + by_y, syy + by_y * dy
                    dy = dy - one
                sx = s0 * dx
                store(
                    sums, np.int64(slots[k + j]) * SUMS,
                    lanes.totals((s0, sx, sy, sx * dx, sy * dx, syy, s_red, s_green, s_blue, s_z)),
                )  # fmt: skip


@kernel(error_model="numpy")
def gather(begin, end, order, offsets, splats, sums, g_means2d, g_splats):
    """Adds up the sums of Gaussians order[begin] .. order[end - 1], always in the same order; writes gradients."""
    half = splats.dtype.type(0.5)
    row = np.empty(SUMS, splats.dtype)
    for rank in range(begin, end):
        i = order[rank]
        total = fill(splats.dtype.type(0))
        for slot in range(offsets[rank], offsets[rank + 1]):
            total = total + load(sums, slot * SUMS)
        store(row, 0, total)
        a, b, c, opacity = splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3]
        g_means2d[i, 0], g_means2d[i, 1] = a * row[1] + b * row[2], b * row[1] + c * row[2]
        g_splats[i, 0], g_splats[i, 1], g_splats[i, 2] = half * row[3], row[4], half * row[5]
        g_splats[i, 3] = -row[0] / opacity if opacity > 0 else row[0]
        for k in range(4):
            g_splats[i, 4 + k] = row[6 + k]
        for k in range(8, RECORD):
            g_splats[i, k] = 0
