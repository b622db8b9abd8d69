"""Alpha blending tile by tile, front to back, and its gradient, back to front.

Per pixel and Gaussian: alpha = min(0.999, opacity exp(-sigma)), skipped below 1/255; the first Gaussian that
would bring the transmittance to 1e-4 or less ends the pixel and is not drawn (gsplat, 3DGS).

The pixels of a tile live in one scratch array of PLANES planes of 256 numbers, so that the loops over pixels
have constant distances between operands and vectorise.
"""

from __future__ import annotations

import math

import numpy as np

from visdom_plugin.compute.fastmath import exp_negative
from visdom_plugin.compute.kernels import kernel
from visdom_plugin.splat.cpu.projection import ALPHA_MIN
from visdom_plugin.splat.cpu.tiles import TILE

ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
SUMS = 10
"""Gradients per intersection: of mean x, y, conic a, b, c, opacity, red, green, blue, z."""

PLANES = 9
PIXELS = TILE * TILE
# Unsigned, else every index would be tested for being negative and nothing would vectorise.
X, Y, T, LAST, RED, GREEN, BLUE, Z, BEHIND = (np.uint64(PIXELS * plane) for plane in range(PLANES))
CHECK_EVERY = 16
"""Gaussians between two looks at which rows are still being drawn."""


@kernel(fast=True)
def _draw(s, p0, p1, place, u, v, a, b, c, opacity, red, green, blue, z):
    """Blends one Gaussian into pixels p0 .. p1 - 1. A pixel that is done has its T negated."""
    real = s.dtype.type
    half, zero, one = real(0.5), real(0), real(1)
    for p in range(np.uint64(p0), np.uint64(p1)):
        dx, dy = u - s[p + X], v - s[p + Y]
        sigma = half * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = min(real(ALPHA_MAX), opacity * exp_negative(sigma))
        t = s[p + T]
        drawn = (sigma >= zero) & (alpha >= real(ALPHA_MIN)) & (t > zero)
        left = t * (one - alpha)
        last = drawn & (left <= real(TRANSMITTANCE_MIN))
        drawn = drawn & (left > real(TRANSMITTANCE_MIN))
        weight = alpha * t if drawn else zero
        s[p + T] = left if drawn else (-t if last else t)
        s[p + LAST] = place if drawn else s[p + LAST]
        s[p + RED] += weight * red
        s[p + GREEN] += weight * green
        s[p + BLUE] += weight * blue
        s[p + Z] += weight * z


@kernel(error_model="numpy")
def _open_rows(s):
    """First and one past the last row of the tile that still has a pixel to draw."""
    first, end = TILE, 0
    for row in range(TILE):
        best = s[T + np.uint64(row * TILE)]
        for p in range(np.uint64(row * TILE), np.uint64((row + 1) * TILE)):
            best = max(best, s[T + p])
        if best > 0:
            first, end = min(first, row), row + 1
    return first, end


@kernel(error_model="numpy")
def _rows(v, reach, top):
    """Rows of a tile whose pixel centres lie within `reach` of v: first and one past the last."""
    first, last = math.ceil(max(v - reach - 0.5 - top, 0)), math.floor(min(v + reach - 0.5 - top, TILE - 1))
    return first, last + 1


@kernel(error_model="numpy")
def blend(
    begin, end, starts, gaussians, columns, means2d, splats, extents, background,
    rgb, alpha, depth, transmittance, last,
):  # fmt: skip
    """Draws tiles begin .. end - 1.

    Writes rgb (H, W, 3) with the background in it, alpha (H, W), depth (H, W) divided by alpha, transmittance
    (H, W), and last (H, W) int32: the index within its tile of the last Gaussian drawn there, or -1.
    """
    height, width = alpha.shape
    real = alpha.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    s = np.empty(PLANES * PIXELS, alpha.dtype)
    for tile in range(begin, end):
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        s[:] = zero
        for p in range(PIXELS):
            y, x = top + p // TILE, left + p % TILE
            s[p + X], s[p + Y] = real(x) + half, real(y) + half
            s[p + T] = one if x < width and y < height else -one
            s[p + LAST] = -one
        first_row, end_row = _open_rows(s)
        start = starts[tile]
        for k in range(start, starts[tile + 1]):
            if (k - start) % CHECK_EVERY == CHECK_EVERY - 1:
                first_row, end_row = _open_rows(s)
                if end_row == 0:
                    break
            g = gaussians[k]
            r0, r1 = _rows(means2d[g, 1], extents[g, 1], top)
            r0, r1 = max(r0, first_row), min(r1, end_row)
            if r0 < r1:
                _draw(
                    s, r0 * TILE, r1 * TILE, real(k - start), means2d[g, 0], means2d[g, 1],
                    splats[g, 0], splats[g, 1], splats[g, 2], splats[g, 3],
                    splats[g, 4], splats[g, 5], splats[g, 6], splats[g, 7],
                )  # fmt: skip
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                p = (y - top) * TILE + x - left
                t = abs(s[p + T])
                transmittance[y, x] = t
                alpha[y, x] = one - t
                rgb[y, x, 0] = s[p + RED] + t * background[0]
                rgb[y, x, 1] = s[p + GREEN] + t * background[1]
                rgb[y, x, 2] = s[p + BLUE] + t * background[2]
                depth[y, x] = s[p + Z] / (one - t) if t < one else zero
                last[y, x] = np.int32(s[p + LAST])


@kernel(fast=True)
def _differentiate(s, p0, p1, place, u, v, a, b, c, opacity, red, green, blue, z):
    """Takes one Gaussian off pixels p0 .. p1 - 1 again; returns its sums of gradients, in moments of the offset.

    T becomes the transmittance in front of it, BEHIND the loss gradient carried by all that lies behind. With q
    the gradient along this Gaussian's colour and depth, dL/dalpha = T q - BEHIND / (1 - alpha).
    """
    real = s.dtype.type
    half, zero, one = real(0.5), real(0), real(1)
    s0, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
    s_red, s_green, s_blue, s_z = zero, zero, zero, zero
    for p in range(np.uint64(p0), np.uint64(p1)):
        dx, dy = u - s[p + X], v - s[p + Y]
        sigma = half * (a * dx * dx + c * dy * dy) + b * dx * dy
        full = opacity * exp_negative(sigma)
        alpha = min(real(ALPHA_MAX), full)
        drawn = (sigma >= zero) & (alpha >= real(ALPHA_MIN)) & (s[p + LAST] >= place)
        inverse = one / (one - alpha)
        t = s[p + T] * inverse
        weight = alpha * t if drawn else zero
        q = s[p + RED] * red + s[p + GREEN] * green + s[p + BLUE] * blue + s[p + Z] * z
        behind = s[p + BEHIND]
        g_sigma = full * (behind * inverse - t * q) if drawn & (full <= real(ALPHA_MAX)) else zero
        s[p + T] = t if drawn else s[p + T]
        s[p + BEHIND] = behind + weight * q
        s_red += weight * s[p + RED]
        s_green += weight * s[p + GREEN]
        s_blue += weight * s[p + BLUE]
        s_z += weight * s[p + Z]
        s0 += g_sigma
        sx += g_sigma * dx
        sy += g_sigma * dy
        sxx += g_sigma * dx * dx
        sxy += g_sigma * dx * dy
        syy += g_sigma * dy * dy
    return s0, sx, sy, sxx, sxy, syy, s_red, s_green, s_blue, s_z


@kernel(error_model="numpy")
def blend_backward(
    begin, end, starts, gaussians, columns, means2d, splats, extents, background,
    alpha, depth, transmittance, last, g_rgb, g_alpha, g_depth, drawn_starts, sums,
):  # fmt: skip
    """Writes the gradients (SUMS,) of each intersection of tiles begin .. end - 1 that was drawn.

    Those of tile t are sums[drawn_starts[t] : drawn_starts[t + 1]], front to back.
    """
    height, width = alpha.shape
    real = alpha.dtype.type
    zero, half = real(0), real(0.5)
    s = np.empty(PLANES * PIXELS, alpha.dtype)
    for tile in range(begin, end):
        count = drawn_starts[tile + 1] - drawn_starts[tile]
        if count == 0:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        s[:] = zero
        s[LAST : LAST + np.uint64(PIXELS)] = real(-1)
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                p = (y - top) * TILE + x - left
                s[p + X], s[p + Y] = real(x) + half, real(y) + half
                t, opaque, gz = transmittance[y, x], alpha[y, x], zero
                s[p + T], s[p + LAST] = t, real(last[y, x])
                # depth = z summed / alpha, and alpha = 1 - T; T also carries the background.
                by_t = -g_alpha[y, x]
                if opaque > zero:
                    gz = g_depth[y, x] / opaque
                    by_t += gz * depth[y, x]
                for channel in range(3):
                    by_t += g_rgb[y, x, channel] * background[channel]
                s[p + RED], s[p + GREEN], s[p + BLUE] = g_rgb[y, x, 0], g_rgb[y, x, 1], g_rgb[y, x, 2]
                s[p + Z], s[p + BEHIND] = gz, t * by_t
        for k in range(count - 1, -1, -1):
            g = gaussians[starts[tile] + k]
            r0, r1 = _rows(means2d[g, 1], extents[g, 1], top)
            out = sums[drawn_starts[tile] + k]
            if r0 >= r1:
                out[:] = zero
                continue
            a, b, c, opacity = splats[g, 0], splats[g, 1], splats[g, 2], splats[g, 3]
            s0, sx, sy, sxx, sxy, syy, out[6], out[7], out[8], out[9] = _differentiate(
                s, r0 * TILE, r1 * TILE, real(k), means2d[g, 0], means2d[g, 1], a, b, c, opacity,
                splats[g, 4], splats[g, 5], splats[g, 6], splats[g, 7],
            )  # fmt: skip
            out[0], out[1] = a * sx + b * sy, b * sx + c * sy
            out[2], out[3], out[4] = half * sxx, sxy, half * syy
            out[5] = -s0 / opacity


@kernel()
def drawn_starts_of(last, columns, tile_count):
    """Prefix sums (tiles + 1,) of how many of each tile's Gaussians were looked at by any pixel to the end."""
    starts = np.zeros(tile_count + 1, np.int64)
    height, width = last.shape
    for y in range(height):
        for x in range(width):
            tile = (y // TILE) * columns + x // TILE
            starts[tile + 1] = max(starts[tile + 1], last[y, x] + 1)
    for tile in range(tile_count):
        starts[tile + 1] += starts[tile]
    return starts


@kernel()
def gather(begin, end, offsets, slot_tiles, slot_places, starts, drawn_starts, sums, g_means2d, g_splats):
    """Adds up, for Gaussians begin .. end - 1, their intersections' gradients, always in the same order."""
    for i in range(begin, end):
        g_means2d[i] = 0
        g_splats[i] = 0
        for slot in range(offsets[i], offsets[i + 1]):
            tile = slot_tiles[slot]
            k = slot_places[slot] - starts[tile]
            if k < drawn_starts[tile + 1] - drawn_starts[tile]:
                row = sums[drawn_starts[tile] + k]
                g_means2d[i, 0] += row[0]
                g_means2d[i, 1] += row[1]
                for j in range(8):
                    g_splats[i, j] += row[2 + j]
