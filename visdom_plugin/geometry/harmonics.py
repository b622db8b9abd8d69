"""Real spherical harmonics to degree 3 with the signs and order of 3DGS (Condon-Shortley phase included)."""

from __future__ import annotations

import math

from visdom_plugin.compute.kernels import kernel

# Normalisation of the real harmonics: constant, degree 1, (xy, yz, xz), 3z^2 - 1, x^2 - y^2, and so on.
C0 = 0.5 * math.sqrt(1 / math.pi)
C1 = 0.5 * math.sqrt(3 / math.pi)
C2_XY = 0.5 * math.sqrt(15 / math.pi)
C2_Z = 0.25 * math.sqrt(5 / math.pi)
C2_XX = 0.25 * math.sqrt(15 / math.pi)
C3_3 = 0.25 * math.sqrt(35 / (2 * math.pi))
C3_2 = 0.5 * math.sqrt(105 / math.pi)
C3_1 = 0.25 * math.sqrt(21 / (2 * math.pi))
C3_0 = 0.25 * math.sqrt(7 / math.pi)
C3_2C = 0.25 * math.sqrt(105 / math.pi)


@kernel(inline="never", error_model="numpy")
def basis(degree, x, y, z, out):
    """Writes the (degree + 1)^2 basis functions at the unit direction (x, y, z) into out (16,)."""
    out[0] = C0
    if degree < 1:
        return
    out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[4], out[5], out[7] = C2_XY * x * y, -C2_XY * y * z, -C2_XY * x * z
    out[6], out[8] = C2_Z * (3 * zz - 1), C2_XX * (xx - yy)
    if degree < 3:
        return
    out[9] = -C3_3 * y * (3 * xx - yy)
    out[10] = C3_2 * x * y * z
    out[11] = -C3_1 * y * (5 * zz - 1)
    out[12] = C3_0 * z * (5 * zz - 3)
    out[13] = -C3_1 * x * (5 * zz - 1)
    out[14] = C3_2C * z * (xx - yy)
    out[15] = -C3_3 * x * (xx - 3 * yy)


@kernel(inline="never", error_model="numpy")
def basis_gradient(degree, x, y, z, d):
    """Writes the derivatives of the basis by x, y, z, each taken as free, into d (16, 3).

    Only their part along the sphere means anything; the caller projects.
    """
    d[:] = 0
    if degree < 1:
        return
    d[1, 1], d[2, 2], d[3, 0] = -C1, C1, -C1
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    d[4, 0], d[4, 1] = C2_XY * y, C2_XY * x
    d[5, 1], d[5, 2] = -C2_XY * z, -C2_XY * y
    d[6, 2] = 6 * C2_Z * z
    d[7, 0], d[7, 2] = -C2_XY * z, -C2_XY * x
    d[8, 0], d[8, 1] = 2 * C2_XX * x, -2 * C2_XX * y
    if degree < 3:
        return
    d[9, 0], d[9, 1] = -6 * C3_3 * x * y, -3 * C3_3 * (xx - yy)
    d[10, 0], d[10, 1], d[10, 2] = C3_2 * y * z, C3_2 * x * z, C3_2 * x * y
    d[11, 1], d[11, 2] = -C3_1 * (5 * zz - 1), -10 * C3_1 * y * z
    d[12, 2] = 3 * C3_0 * (5 * zz - 1)
    d[13, 0], d[13, 2] = -C3_1 * (5 * zz - 1), -10 * C3_1 * x * z
    d[14, 0], d[14, 1], d[14, 2] = 2 * C3_2C * x * z, -2 * C3_2C * y * z, C3_2C * (xx - yy)
    d[15, 0], d[15, 1] = -3 * C3_3 * (xx - yy), 6 * C3_3 * x * y
