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


@kernel(inline="always", error_model="numpy")
def higher(x, y, z):
    """Basis functions 1 to 15 at the unit direction (x, y, z): of numbers, or of vectors of numbers."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        -C1 * y, C1 * z, -C1 * x,
        C2_XY * x * y, -C2_XY * y * z, C2_Z * (3 * zz - 1), -C2_XY * x * z, C2_XX * (xx - yy),
        -C3_3 * y * (3 * xx - yy), C3_2 * x * y * z, -C3_1 * y * (5 * zz - 1), C3_0 * z * (5 * zz - 3),
        -C3_1 * x * (5 * zz - 1), C3_2C * z * (xx - yy), -C3_3 * x * (xx - 3 * yy),
    )  # fmt: skip


@kernel(inline="always", error_model="numpy")
def higher_gradient(x, y, z, w1, w2, w3, w4, w5, w6, w7, w8, w9, w10, w11, w12, w13, w14, w15):
    """Derivatives by x, y, z, each taken as free, of the sum of basis functions 1 to 15 times w1 to w15.

    Only their part along the sphere means anything; the caller projects.
    """
    apart, fives = x * x - y * y, 5 * z * z - 1
    return (
        -C1 * w3 + C2_XY * (y * w4 - z * w7) + 2 * C2_XX * x * w8 - 6 * C3_3 * x * y * w9 + C3_2 * y * z * w10
        - C3_1 * fives * w13 + 2 * C3_2C * x * z * w14 - 3 * C3_3 * apart * w15,
        -C1 * w1 + C2_XY * (x * w4 - z * w5) - 2 * C2_XX * y * w8 - 3 * C3_3 * apart * w9 + C3_2 * x * z * w10
        - C3_1 * fives * w11 - 2 * C3_2C * y * z * w14 + 6 * C3_3 * x * y * w15,
        C1 * w2 - C2_XY * (y * w5 + x * w7) + 6 * C2_Z * z * w6 + C3_2 * x * y * w10
        - 10 * C3_1 * z * (y * w11 + x * w13) + 3 * C3_0 * fives * w12 + C3_2C * apart * w14,
    )  # fmt: skip


@kernel(inline="never", error_model="numpy")
def basis(degree, x, y, z, out):
    """Writes the (degree + 1)^2 basis functions at the unit direction (x, y, z) into out (16,)."""
    out[0] = C0
    functions = higher(x, y, z)
    for k in range(1, (degree + 1) * (degree + 1)):
        out[k] = functions[k - 1]
