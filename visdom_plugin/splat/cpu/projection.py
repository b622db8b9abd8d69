"""From Gaussians in the world to ellipses in the image, and gradients back (EWA: Zwicker et al. 2001).

Conventions as gsplat's "classic" mode: covariance J W R S S R^T W^T J^T + 0.3 I in pixels, the Jacobian J
taken at x/z and y/z clamped to the image widened by 30 % of half its field of view.

Per Gaussian, besides means2d (N, 2), one record of splats (N, RECORD), as long as a cache line; all zero for
Gaussians not drawn:
  0 to 7: conic a, b, c (sigma = (a dx^2 + c dy^2) / 2 + b dx dy), opacity, red, green, blue, camera z: the part
    that is differentiated
  8, 9: means2d once more
  10, 11: half width and half height in pixels of the box around all alpha >= 1/255
  12: tau = 2 ln(255 opacity), the squared radius of that isoline
  13: log2 of the opacity
`camera` is (20,): world-to-camera rotation by rows, translation, fx, fy, cx, cy, camera centre, near plane.

16 Gaussians are one vector of each number, and there must be 16 at least. Where N is no multiple of 16 the last
vector begins earlier; what it shares with the one before comes out the same.
"""

from __future__ import annotations

import math

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lane_math import exp, log2
from visdom_plugin.compute.lanes import (
    WIDTH,
    any_of,
    ceil,
    fill,
    load,
    maximum,
    minimum,
    put,
    sqrt,
    store,
    store_all,
    take,
    transpose,
    where,
)
from visdom_plugin.geometry.harmonics import C0, higher, higher_gradient
from visdom_plugin.splat.cpu.tiles import count_tiles, scratch

DILATION = 0.3  # px^2, 3DGS's low-pass filter
ALPHA_MIN = 1 / 255
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
FRUSTUM_MARGIN = 0.3
RECORD = 16
"""Numbers per Gaussian in `splats`."""
LOG2_E = 1 / math.log(2)
LARGEST = 80.0
"""Logarithm of a standard deviation beyond which its square overflows."""

assert RECORD == WIDTH

# A kernel's scratch array: vectors of the records and their gradients, by fields; axes in camera coordinates and
# their gradients, by rows; basis functions, and their part in the loss; harmonics, by numbers of a Gaussian.
FIELDS, G_FIELDS, AXES, G_AXES, BASIS, WEIGHTS, SH = (WIDTH * plane for plane in (0, 16, 32, 41, 50, 66, 82))
PLANES = 130


@kernel(fast=True)
def _turned(a, b, c, x, y, z):
    """A row (a, b, c) of the camera's rotation times a vector."""
    return a * x + b * y + c * z


@kernel(fast=True)
def _camera_point(i, means, camera):
    """World coordinates of 16 means and camera coordinates."""
    mx, my, mz = take(means, 3 * i, 3), take(means, 3 * i + 1, 3), take(means, 3 * i + 2, 3)
    x = _turned(camera[0], camera[1], camera[2], mx, my, mz) + camera[9]
    y = _turned(camera[3], camera[4], camera[5], mx, my, mz) + camera[10]
    return mx, my, mz, x, y, _turned(camera[6], camera[7], camera[8], mx, my, mz) + camera[11]


@kernel(fast=True)
def _unit_quaternion(i, quaternions):
    w, x = take(quaternions, 4 * i, 4), take(quaternions, 4 * i + 1, 4)
    y, z = take(quaternions, 4 * i + 2, 4), take(quaternions, 4 * i + 3, 4)
    length = maximum(sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w / length, x / length, y / length, z / length, length


@kernel(fast=True)
def _put_axes(i, quaternions, camera, s):
    """Writes the Gaussians' axes in camera coordinates."""
    w, x, y, z, _ = _unit_quaternion(i, quaternions)
    x0, y0, z0 = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    x1, y1, z1 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    x2, y2, z2 = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    for row in range(3):
        a, b, c = camera[3 * row], camera[3 * row + 1], camera[3 * row + 2]
        axes = _turned(a, b, c, x0, y0, z0), _turned(a, b, c, x1, y1, z1), _turned(a, b, c, x2, y2, z2)
        store_all(s, AXES + WIDTH * 3 * row, axes)


@kernel(fast=True)
def _axis(s, k):
    """x, y, z of axis k."""
    return (
        load(s, AXES + WIDTH * k), load(s, AXES + WIDTH * (3 + k)), load(s, AXES + WIDTH * (6 + k))
    )  # fmt: skip


@kernel(fast=True)
def _limits(focal, centre, size):
    """The least and the largest ratio x/z at which the Jacobian is trusted."""
    margin = type(focal)(FRUSTUM_MARGIN * 0.5) * size / focal
    return -centre / focal - margin, (size - centre) / focal + margin


@kernel(fast=True)
def _direction(mx, my, mz, camera):
    """Unit vectors from the camera's centre to the means, and their distances."""
    dx, dy, dz = mx - camera[16], my - camera[17], mz - camera[18]
    length = maximum(sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    return dx / length, dy / length, dz / length, length


@kernel(fast=True)
def _put_basis(degree, x, y, z, s):
    """Writes basis functions, zero beyond the degree."""
    none = x * 0
    store(s, BASIS, none + C0)
    store_all(s, BASIS + WIDTH, higher(x, y, z))
    for k in range((degree + 1) * (degree + 1), WIDTH):
        store(s, BASIS + WIDTH * k, none)


@kernel(fast=True)
def _fetch_sh(i, count, sh, s):
    """Writes the first `count` harmonics of 16 Gaussians, by numbers."""
    numbers = 3 * sh.shape[1]
    if numbers == 3 * WIDTH:
        for part in range(0, 3 * count, WIDTH):
            transpose(sh, i * numbers + part, numbers, s, SH + WIDTH * part, WIDTH)
    else:
        for k in range(3 * count):
            store(s, SH + WIDTH * k, take(sh, i * numbers + k, numbers))


@kernel(error_model="numpy")
def project(
    begin, end, means, log_scales, quaternions, opacity_logits, sh, degree, camera, width, height,
    means2d, splats, radii, visible, tiles,
):  # fmt: skip
    """Projects Gaussians begin .. end - 1; see the module's text for the arrays written.

    `radii` (N, 2) are gsplat's, in whole pixels, `visible` (N,) tells where both are above 0, and `tiles` (N,) how
    many tiles of the image each meets.
    """
    real = means.dtype.type
    fx, fy, cx, cy, near = camera[12], camera[13], camera[14], camera[15], camera[19]
    low_x, high_x = _limits(fx, cx, real(width))
    low_y, high_y = _limits(fy, cy, real(height))
    s = scratch(means, WIDTH * PLANES)
    zero = fill(real(0))
    n_basis = (degree + 1) * (degree + 1)
    for first in range(begin, end, WIDTH):
        i = min(first, len(means) - WIDTH)
        mx, my, mz, x, y, z = _camera_point(i, means, camera)
        logit = load(opacity_logits, i)
        opacity = 1 / (1 + exp(0 - logit))
        # Written so that NaN fails.
        drawn = (z >= near) & (opacity >= real(ALPHA_MIN)) & (logit > -LARGEST)
        for field in range(RECORD):
            store(s, FIELDS + WIDTH * field, zero)
        u, v, radius_x, radius_y, count = zero, zero, zero, zero, zero
        if any_of(drawn):
            _put_axes(i, quaternions, camera, s)
            jx, jy = fx / z, fy / z
            jxz = 0 - jx * minimum(maximum(x / z, low_x), high_x)
            jyz = 0 - jy * minimum(maximum(y / z, low_y), high_y)
            xx, xy, yy = zero + DILATION, zero, zero + DILATION
            for k in range(3):
                log_scale = take(log_scales, 3 * i + k, 3)
                drawn = drawn & (log_scale < LARGEST)
                scale = exp(log_scale)
                ax, ay, az = _axis(s, k)
                tu, tv = (jx * ax + jxz * az) * scale, (jy * ay + jyz * az) * scale
                xx, xy, yy = xx + tu * tu, xy + tu * tv, yy + tv * tv
            determinant = xx * yy - xy * xy
            # A little above the least opacity, log2 may be a rounding error below 0.
            tau = maximum((log2(opacity) - LOG2_ALPHA_MIN) * (2 * math.log(2)), 0)
            # gsplat's integer radii, for densification; the finer extents decide what is drawn.
            reach = minimum(sqrt(tau), 3.33)
            radius_x, radius_y = ceil(reach * sqrt(xx)), ceil(reach * sqrt(yy))
            u, v = fx * x / z + cx, fy * y / z + cy
            drawn = drawn & (determinant > 0) & (radius_x < 1e9) & (radius_y < 1e9)
            drawn = drawn & (u + radius_x > 0) & (u - radius_x < width)
            drawn = drawn & (v + radius_y > 0) & (v - radius_y < height)
        if any_of(drawn):
            dx, dy, dz, _ = _direction(mx, my, mz, camera)
            _put_basis(degree, dx, dy, dz, s)
            _fetch_sh(i, n_basis, sh, s)
            red, green, blue = zero + 0.5, zero + 0.5, zero + 0.5
            for k in range(n_basis):
                value = load(s, BASIS + WIDTH * k)
                red = red + value * load(s, SH + WIDTH * 3 * k)
                green = green + value * load(s, SH + WIDTH * (3 * k + 1))
                blue = blue + value * load(s, SH + WIDTH * (3 * k + 2))
            # A hundredth of a pixel more: rounding must never cut what the test of alpha would keep.
            fields = (
                yy / determinant, (0 - xy) / determinant, xx / determinant, opacity,
                maximum(red, 0), maximum(green, 0), maximum(blue, 0), z,
                u, v, sqrt(tau * xx) + 0.01, sqrt(tau * yy) + 0.01,
                tau * 1.001 + 0.001, tau * (0.5 * LOG2_E) + LOG2_ALPHA_MIN,
            )  # fmt: skip
            store_all(s, FIELDS, fields)
            for k in range(len(fields)):
                store(s, FIELDS + WIDTH * k, where(drawn, load(s, FIELDS + WIDTH * k), 0))
            count = count_tiles(s, FIELDS, width, height)
        transpose(s, FIELDS, WIDTH, splats, RECORD * i, RECORD)
        put(means2d, 2 * i, 2, where(drawn, u, 0))
        put(means2d, 2 * i + 1, 2, where(drawn, v, 0))
        put(radii, 2 * i, 2, where(drawn, radius_x, 0))
        put(radii, 2 * i + 1, 2, where(drawn, radius_y, 0))
        put(visible, i, 1, where(drawn & (radius_x > 0) & (radius_y > 0), fill(real(1)), 0))
        put(tiles, i, 1, count)


@kernel(error_model="numpy")
def project_backward(
    begin, end, means, log_scales, quaternions, sh, degree, camera, width, height, splats,
    g_means2d, g_splats, g_means, g_log_scales, g_quaternions, g_opacity_logits, g_sh,
):  # fmt: skip
    """Writes the gradients of Gaussians begin .. end - 1 from those of means2d and splats."""
    real = means.dtype.type
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    low_x, high_x = _limits(fx, cx, real(width))
    low_y, high_y = _limits(fy, cy, real(height))
    s = scratch(means, WIDTH * PLANES)
    zero = fill(real(0))
    numbers = 3 * sh.shape[1]
    for first in range(begin, end, WIDTH):
        i = min(first, len(means) - WIDTH)
        transpose(splats, RECORD * i, RECORD, s, FIELDS, WIDTH)
        transpose(g_splats, RECORD * i, RECORD, s, G_FIELDS, WIDTH)
        drawn = load(s, FIELDS + WIDTH * 12) > 0
        mx, my, mz, x, y, z = _camera_point(i, means, camera)
        _put_axes(i, quaternions, camera, s)
        ratio_x, ratio_y = x / z, y / z
        tx = minimum(maximum(ratio_x, low_x), high_x)
        ty = minimum(maximum(ratio_y, low_y), high_y)
        jx, jy = fx / z, fy / z
        jxz, jyz = 0 - jx * tx, 0 - jy * ty

        # conic = cov^-1, hence g_cov = -conic g_conic conic; b stands for two equal entries.
        a, b, c = load(s, FIELDS), load(s, FIELDS + WIDTH), load(s, FIELDS + WIDTH * 2)
        ga, gb, gc = load(s, G_FIELDS), 0.5 * load(s, G_FIELDS + WIDTH), load(s, G_FIELDS + WIDTH * 2)
        p00, p01, p10, p11 = a * ga + b * gb, a * gb + b * gc, b * ga + c * gb, b * gb + c * gc
        gxx, gxy, gyy = 0 - (p00 * a + p01 * b), 0 - (p00 * b + p01 * c), 0 - (p10 * b + p11 * c)

        # cov = sum_k t_k t_k^T + 0.3 I with t_k = s_k J m_k.
        g_jx, g_jy, g_jxz, g_jyz = zero, zero, zero, zero
        for k in range(3):
            ax, ay, az = _axis(s, k)
            scale = exp(take(log_scales, 3 * i + k, 3))
            u, v = jx * ax + jxz * az, jy * ay + jyz * az
            gu, gv = 2 * (gxx * u + gxy * v) * scale, 2 * (gxy * u + gyy * v) * scale
            put(g_log_scales, 3 * i + k, 3, where(drawn, (gu * u + gv * v) * scale, 0))
            gu, gv = gu * scale, gv * scale
            g_jx, g_jy = g_jx + gu * ax, g_jy + gv * ay
            g_jxz, g_jyz = g_jxz + gu * az, g_jyz + gv * az
            gx, gy, gz = jx * gu, jy * gv, jxz * gu + jyz * gv
            for j in range(3):
                store(
                    s, G_AXES + WIDTH * (3 * j + k), camera[j] * gx + camera[3 + j] * gy + camera[6 + j] * gz
                )
        _rotation_backward(i, quaternions, s, drawn, g_quaternions)

        g_u, g_v = take(g_means2d, 2 * i, 2), take(g_means2d, 2 * i + 1, 2)
        gx, gy = g_u * jx, g_v * jy
        gz = load(s, G_FIELDS + WIDTH * 7) - (g_u * jx * x + g_v * jy * y + g_jx * jx + g_jy * jy) / z
        # jxz = -fx tx / z, where tx = x / z inside the frustum and constant outside.
        gz = gz - (g_jxz * jxz + g_jyz * jyz) / z
        slope_x = where((low_x <= ratio_x) & (ratio_x <= high_x), g_jxz * jx / z, 0)
        slope_y = where((low_y <= ratio_y) & (ratio_y <= high_y), g_jyz * jy / z, 0)
        gx, gy, gz = gx - slope_x, gy - slope_y, gz + slope_x * tx + slope_y * ty
        opacity = load(s, FIELDS + WIDTH * 3)
        g_opacity = load(s, G_FIELDS + WIDTH * 3) * opacity * (1 - opacity)
        put(g_opacity_logits, i, 1, where(drawn, g_opacity, 0))

        dx, dy, dz, length = _direction(mx, my, mz, camera)
        _put_basis(degree, dx, dy, dz, s)
        _fetch_sh(i, sh.shape[1], sh, s)
        # The colour is clamped at 0, and that of what is not drawn is 0.
        red = where(load(s, FIELDS + WIDTH * 4) > 0, load(s, G_FIELDS + WIDTH * 4), 0)
        green = where(load(s, FIELDS + WIDTH * 5) > 0, load(s, G_FIELDS + WIDTH * 5), 0)
        blue = where(load(s, FIELDS + WIDTH * 6) > 0, load(s, G_FIELDS + WIDTH * 6), 0)
        for k in range(WIDTH):
            store(s, WEIGHTS + WIDTH * k, zero)
        for k in range(sh.shape[1]):
            value, at = where(drawn, load(s, BASIS + WIDTH * k), 0), SH + WIDTH * 3 * k
            if k < (degree + 1) * (degree + 1):
                weight = load(s, at) * red + load(s, at + WIDTH) * green + load(s, at + 2 * WIDTH) * blue
                store(s, WEIGHTS + WIDTH * k, weight)
            store(s, at, value * red)
            store(s, at + WIDTH, value * green)
            store(s, at + 2 * WIDTH, value * blue)
        if numbers == 3 * WIDTH:
            for part in range(0, numbers, WIDTH):
                transpose(s, SH + WIDTH * part, WIDTH, g_sh, i * numbers + part, numbers)
        else:
            for k in range(numbers):
                put(g_sh, i * numbers + k, numbers, load(s, SH + WIDTH * k))
        sx, sy, sz = _slopes(dx, dy, dz, s)
        along = sx * dx + sy * dy + sz * dz
        sx, sy, sz = (sx - along * dx) / length, (sy - along * dy) / length, (sz - along * dz) / length
        put(g_means, 3 * i, 3, where(drawn, camera[0] * gx + camera[3] * gy + camera[6] * gz + sx, 0))
        put(g_means, 3 * i + 1, 3, where(drawn, camera[1] * gx + camera[4] * gy + camera[7] * gz + sy, 0))
        put(g_means, 3 * i + 2, 3, where(drawn, camera[2] * gx + camera[5] * gy + camera[8] * gz + sz, 0))


@kernel(fast=True)
def _slopes(x, y, z, s):
    """Derivatives by the direction of the colours' part of the loss."""
    return higher_gradient(
        x, y, z,
        load(s, WEIGHTS + WIDTH), load(s, WEIGHTS + 2 * WIDTH), load(s, WEIGHTS + 3 * WIDTH),
        load(s, WEIGHTS + 4 * WIDTH), load(s, WEIGHTS + 5 * WIDTH), load(s, WEIGHTS + 6 * WIDTH),
        load(s, WEIGHTS + 7 * WIDTH), load(s, WEIGHTS + 8 * WIDTH), load(s, WEIGHTS + 9 * WIDTH),
        load(s, WEIGHTS + 10 * WIDTH), load(s, WEIGHTS + 11 * WIDTH), load(s, WEIGHTS + 12 * WIDTH),
        load(s, WEIGHTS + 13 * WIDTH), load(s, WEIGHTS + 14 * WIDTH), load(s, WEIGHTS + 15 * WIDTH),
    )  # fmt: skip


@kernel(fast=True)
def _rotation_backward(i, quaternions, s, drawn, g_quaternions):
    """Writes the gradient of quaternions of any length from that of their rotation matrices."""
    w, x, y, z, length = _unit_quaternion(i, quaternions)
    g00, g01, g02 = load(s, G_AXES), load(s, G_AXES + WIDTH), load(s, G_AXES + 2 * WIDTH)
    g10, g11, g12 = load(s, G_AXES + 3 * WIDTH), load(s, G_AXES + 4 * WIDTH), load(s, G_AXES + 5 * WIDTH)
    g20, g21, g22 = load(s, G_AXES + 6 * WIDTH), load(s, G_AXES + 7 * WIDTH), load(s, G_AXES + 8 * WIDTH)
    gw = 2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    gx = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12)) - 4 * x * (g11 + g22)
    gy = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20)) - 4 * y * (g00 + g22)
    gz = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01)) - 4 * z * (g00 + g11)
    along = gw * w + gx * x + gy * y + gz * z
    put(g_quaternions, 4 * i, 4, where(drawn, (gw - along * w) / length, 0))
    put(g_quaternions, 4 * i + 1, 4, where(drawn, (gx - along * x) / length, 0))
    put(g_quaternions, 4 * i + 2, 4, where(drawn, (gy - along * y) / length, 0))
    put(g_quaternions, 4 * i + 3, 4, where(drawn, (gz - along * z) / length, 0))
