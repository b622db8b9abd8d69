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
"""

from __future__ import annotations

import math

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lanes import fill, store
from visdom_plugin.geometry.harmonics import basis, basis_gradient
from visdom_plugin.splat.cpu.tiles import count_tiles

DILATION = 0.3  # px^2, 3DGS's low-pass filter
ALPHA_MIN = 1 / 255
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
FRUSTUM_MARGIN = 0.3
RECORD = 16
"""Numbers per Gaussian in `splats`."""
LOG2_E = 1 / math.log(2)


@kernel(error_model="numpy")
def _unit_quaternion(q):
    length = max(math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), q.dtype.type(1e-12))
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length, length


@kernel(error_model="numpy")
def _axes(i, log_scales, quaternions, camera, m, s):
    """Writes the Gaussian's axes in camera coordinates (columns of m) and its standard deviations s."""
    w, x, y, z, _ = _unit_quaternion(quaternions[i])
    one, two = m.dtype.type(1), m.dtype.type(2)
    r00, r01, r02 = one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    r10, r11, r12 = two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)
    r20, r21, r22 = two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)
    for row in range(3):
        v0, v1, v2 = camera[3 * row], camera[3 * row + 1], camera[3 * row + 2]
        m[row, 0] = v0 * r00 + v1 * r10 + v2 * r20
        m[row, 1] = v0 * r01 + v1 * r11 + v2 * r21
        m[row, 2] = v0 * r02 + v1 * r12 + v2 * r22
    for axis in range(3):
        s[axis] = math.exp(log_scales[i, axis])


@kernel(error_model="numpy")
def _clamped(ratio, focal, centre, size):
    """The ratio x/z kept where the Jacobian is trusted, and whether it was inside."""
    real = type(ratio)
    margin = real(FRUSTUM_MARGIN * 0.5) * size / focal
    low, high = -centre / focal - margin, (size - centre) / focal + margin
    return min(high, max(low, ratio)), low <= ratio <= high


@kernel(error_model="numpy")
def _camera_point(mean, camera):
    x = camera[0] * mean[0] + camera[1] * mean[1] + camera[2] * mean[2] + camera[9]
    y = camera[3] * mean[0] + camera[4] * mean[1] + camera[5] * mean[2] + camera[10]
    z = camera[6] * mean[0] + camera[7] * mean[1] + camera[8] * mean[2] + camera[11]
    return x, y, z


@kernel(error_model="numpy")
def project(
    begin, end, means, log_scales, quaternions, opacity_logits, sh, degree, camera, width, height,
    means2d, splats, radii, tiles,
):  # fmt: skip
    """Projects Gaussians begin .. end - 1; see the module's text for the arrays written.

    `radii` (N, 2) are gsplat's, in whole pixels, and `tiles` (N,) how many tiles of the image each meets.
    """
    real = means.dtype.type
    one, zero = real(1), real(0)
    fx, fy, cx, cy, near = camera[12], camera[13], camera[14], camera[15], camera[19]
    m, s, values = np.empty((3, 3), means.dtype), np.empty(3, means.dtype), np.empty(16, means.dtype)
    n_basis = (degree + 1) * (degree + 1)
    for i in range(begin, end):
        store(splats, i * RECORD, fill(zero))
        means2d[i, 0], means2d[i, 1] = zero, zero
        radii[i, 0], radii[i, 1], tiles[i] = 0, 0, 0
        x, y, z = _camera_point(means[i], camera)
        opacity = one / (one + math.exp(-opacity_logits[i]))
        # Written so that NaN fails.
        if not (z >= near and opacity >= real(ALPHA_MIN)):
            continue
        _axes(i, log_scales, quaternions, camera, m, s)
        tx, _ = _clamped(x / z, fx, cx, real(width))
        ty, _ = _clamped(y / z, fy, cy, real(height))
        jx, jy, jxz, jyz = fx / z, fy / z, -fx * tx / z, -fy * ty / z
        xx, xy, yy = real(DILATION), zero, real(DILATION)
        for k in range(3):
            u = (jx * m[0, k] + jxz * m[2, k]) * s[k]
            v = (jy * m[1, k] + jyz * m[2, k]) * s[k]
            xx += u * u
            xy += u * v
            yy += v * v
        determinant = xx * yy - xy * xy
        tau = real(2) * math.log(opacity / real(ALPHA_MIN))
        # gsplat's integer radii, for densification; the finer extents decide what is drawn.
        reach = min(real(3.33), math.sqrt(tau))
        radius_x, radius_y = math.ceil(reach * math.sqrt(xx)), math.ceil(reach * math.sqrt(yy))
        u, v = fx * x / z + cx, fy * y / z + cy
        drawn = determinant > zero and u + radius_x > zero and u - radius_x < real(width)
        if not (drawn and v + radius_y > zero and v - radius_y < real(height) and radius_x < real(1e9)):
            continue
        means2d[i, 0], means2d[i, 1] = u, v
        splats[i, 0], splats[i, 1], splats[i, 2] = yy / determinant, -xy / determinant, xx / determinant
        splats[i, 3], splats[i, 7] = opacity, z
        radii[i, 0], radii[i, 1] = np.int32(radius_x), np.int32(radius_y)
        splats[i, 8], splats[i, 9] = u, v
        # A hundredth of a pixel more: rounding must never cut what the test of alpha would keep.
        splats[i, 10] = math.sqrt(tau * xx) + real(0.01)
        splats[i, 11] = math.sqrt(tau * yy) + real(0.01)
        splats[i, 12] = tau * real(1.001) + real(0.001)
        splats[i, 13] = real(0.5 * LOG2_E) * tau + real(LOG2_ALPHA_MIN)
        tiles[i] = count_tiles(splats, i, width, height)

        dx, dy, dz = means[i, 0] - camera[16], means[i, 1] - camera[17], means[i, 2] - camera[18]
        length = max(math.sqrt(dx * dx + dy * dy + dz * dz), real(1e-12))
        basis(degree, dx / length, dy / length, dz / length, values)
        red, green, blue = real(0.5), real(0.5), real(0.5)
        for k in range(n_basis):
            red += values[k] * sh[i, k, 0]
            green += values[k] * sh[i, k, 1]
            blue += values[k] * sh[i, k, 2]
        splats[i, 4], splats[i, 5], splats[i, 6] = max(red, zero), max(green, zero), max(blue, zero)


@kernel(error_model="numpy")
def project_backward(
    begin, end, means, log_scales, quaternions, sh, degree, camera, width, height, splats,
    g_means2d, g_splats, g_means, g_log_scales, g_quaternions, g_opacity_logits, g_sh,
):  # fmt: skip
    """Writes the gradients of Gaussians begin .. end - 1 from those of means2d and splats."""
    real = means.dtype.type
    one, zero, half, two = real(1), real(0), real(0.5), real(2)
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    m, s = np.empty((3, 3), means.dtype), np.empty(3, means.dtype)
    g_m, g_r = np.empty((3, 3), means.dtype), np.empty((3, 3), means.dtype)
    values, slopes = np.empty(16, means.dtype), np.empty((16, 3), means.dtype)
    n_basis = (degree + 1) * (degree + 1)
    for i in range(begin, end):
        if splats[i, 12] == zero:
            for k in range(3):
                g_means[i, k], g_log_scales[i, k] = zero, zero
            for k in range(4):
                g_quaternions[i, k] = zero
            g_opacity_logits[i] = zero
            for k in range(sh.shape[1]):
                g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = zero, zero, zero
            continue
        x, y, z = _camera_point(means[i], camera)
        _axes(i, log_scales, quaternions, camera, m, s)
        tx, inside_x = _clamped(x / z, fx, cx, real(width))
        ty, inside_y = _clamped(y / z, fy, cy, real(height))
        jx, jy, jxz, jyz = fx / z, fy / z, -fx * tx / z, -fy * ty / z

        # conic = cov^-1, hence g_cov = -conic g_conic conic; b stands for two equal entries.
        a, b, c = splats[i, 0], splats[i, 1], splats[i, 2]
        ga, gb, gc = g_splats[i, 0], half * g_splats[i, 1], g_splats[i, 2]
        p00, p01, p10, p11 = a * ga + b * gb, a * gb + b * gc, b * ga + c * gb, b * gb + c * gc
        gxx, gxy, gyy = -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)

        # cov = sum_k t_k t_k^T + 0.3 I with t_k = s_k J m_k.
        g_jx, g_jy, g_jxz, g_jyz = zero, zero, zero, zero
        for k in range(3):
            u = jx * m[0, k] + jxz * m[2, k]
            v = jy * m[1, k] + jyz * m[2, k]
            gu = two * (gxx * u + gxy * v) * s[k]
            gv = two * (gxy * u + gyy * v) * s[k]
            g_log_scales[i, k] = (gu * u + gv * v) * s[k]
            gu, gv = gu * s[k], gv * s[k]
            g_jx += gu * m[0, k]
            g_jy += gv * m[1, k]
            g_jxz += gu * m[2, k]
            g_jyz += gv * m[2, k]
            g_m[0, k], g_m[1, k], g_m[2, k] = jx * gu, jy * gv, jxz * gu + jyz * gv

        g_u, g_v = g_means2d[i, 0], g_means2d[i, 1]
        gx, gy = g_u * jx, g_v * jy
        gz = g_splats[i, 7] - (g_u * jx * x + g_v * jy * y + g_jx * jx + g_jy * jy) / z
        # jxz = -fx tx / z, where tx = x / z inside the frustum and constant outside.
        gz -= (g_jxz * jxz + g_jyz * jyz) / z
        if inside_x:
            gx -= g_jxz * jx / z
            gz += g_jxz * jx * tx / z
        if inside_y:
            gy -= g_jyz * jy / z
            gz += g_jyz * jy * ty / z
        for k in range(3):
            g_means[i, k] = camera[k] * gx + camera[3 + k] * gy + camera[6 + k] * gz
            for j in range(3):
                g_r[j, k] = camera[j] * g_m[0, k] + camera[3 + j] * g_m[1, k] + camera[6 + j] * g_m[2, k]
        _rotation_backward(quaternions[i], g_r, g_quaternions[i])
        opacity = splats[i, 3]
        g_opacity_logits[i] = g_splats[i, 3] * opacity * (one - opacity)

        red = g_splats[i, 4] if splats[i, 4] > zero else zero
        green = g_splats[i, 5] if splats[i, 5] > zero else zero
        blue = g_splats[i, 6] if splats[i, 6] > zero else zero
        dx, dy, dz = means[i, 0] - camera[16], means[i, 1] - camera[17], means[i, 2] - camera[18]
        length = max(math.sqrt(dx * dx + dy * dy + dz * dz), real(1e-12))
        dx, dy, dz = dx / length, dy / length, dz / length
        basis(degree, dx, dy, dz, values)
        for k in range(n_basis):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = values[k] * red, values[k] * green, values[k] * blue
        for k in range(n_basis, sh.shape[1]):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = zero, zero, zero
        if degree > 0:
            basis_gradient(degree, dx, dy, dz, slopes)
            gx, gy, gz = zero, zero, zero
            for k in range(1, n_basis):
                weight = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
                gx += weight * slopes[k, 0]
                gy += weight * slopes[k, 1]
                gz += weight * slopes[k, 2]
            along = gx * dx + gy * dy + gz * dz
            g_means[i, 0] += (gx - along * dx) / length
            g_means[i, 1] += (gy - along * dy) / length
            g_means[i, 2] += (gz - along * dz) / length


@kernel(error_model="numpy")
def _rotation_backward(quaternion, g, out):
    """Gradient of a quaternion of any length from that of its rotation matrix, g (3, 3)."""
    two = g.dtype.type(2)
    w, x, y, z, length = _unit_quaternion(quaternion)
    gw = two * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = two * (y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]))
    gx -= two * two * x * (g[1, 1] + g[2, 2])
    gy = two * (x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]))
    gy -= two * two * y * (g[0, 0] + g[2, 2])
    gz = two * (x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]))
    gz -= two * two * z * (g[0, 0] + g[1, 1])
    along = gw * w + gx * x + gy * y + gz * z
    out[0], out[1] = (gw - along * w) / length, (gx - along * x) / length
    out[2], out[3] = (gy - along * y) / length, (gz - along * z) / length
