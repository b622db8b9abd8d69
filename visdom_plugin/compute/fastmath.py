"""exp that LLVM can vectorise, for the kernels' own use."""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import fast_overload


@intrinsic
def _float_from_bits(typing_context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


def exp_negative(x):
    """exp(-x) for x >= 0. In float32 within 2e-7 relative for x <= 87, and constant beyond."""
    raise NotImplementedError("compiled code only")


@fast_overload(exp_negative)
def _exp_negative(x):
    if x != types.float32:
        return lambda x: math.exp(-x)

    # 2^t = 2^k 2^f with |f| <= 1/2: the Taylor series of 2^f to degree 6 errs by at most 1.4e-7.
    log2_e = np.float32(-1.4426950408889634)
    lowest, half, one = np.float32(-126), np.float32(0.5), np.float32(1)
    c1, c2, c3, c4, c5, c6 = (np.float32(math.log(2) ** n / math.factorial(n)) for n in range(1, 7))
    bias, shift = np.int32(127), np.int32(23)

    def polynomial(x):
        t = max(x * log2_e, lowest)
        k = np.floor(t + half)
        f = t - k
        power = f * (f * (f * (f * (f * (f * c6 + c5) + c4) + c3) + c2) + c1) + one
        return power * _float_from_bits((np.int32(k) + bias) << shift)

    return polynomial
