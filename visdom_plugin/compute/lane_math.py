"""exp and log of vectors of 16 numbers, by polynomials."""

from __future__ import annotations

import math

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lanes import (
    WIDTH,
    call_each,
    constant_of,
    maximum,
    minimum,
    where,
)

SQRT_HALF = math.sqrt(0.5)
_EXP2 = {
    # Least relative error on [-1/2, 1/2]: 8e-8.
    types.float32: (
        1.0000000716553024, 0.6931469670628859, 0.24022119720751128, 0.05550713275064405, 0.009675541502638427,
        0.0013276471960119753,
    ),
    # The Taylor series to 1e-14.
    types.float64: tuple(math.log(2) ** n / math.factorial(n) for n in range(12)),
}  # fmt: skip


@intrinsic
def exp2(typing_context, lanes):
    """2 to the power of each lane, within 3e-7 relative in float32. For exponents of normal numbers only."""
    element = lanes.element
    bits, mantissa = (32, 23) if element == types.float32 else (64, 52)
    coefficients = _EXP2[element]

    def generate(context, builder, signature, arguments):
        def constant(value):
            return constant_of(element, [value] * WIDTH)

        def multiply_add(x, y, z):
            return builder.fadd(builder.fmul(x, y, flags=("contract",)), z, flags=("contract",))

        whole = call_each(builder, "rint", arguments[0])
        x = builder.fsub(arguments[0], whole)
        # Pairs of coefficients first: half the wait of going through them one by one.
        square = builder.fmul(x, x)
        pairs = [
            multiply_add(constant(odd), x, constant(even))
            for even, odd in zip(coefficients[::2], coefficients[1::2], strict=True)
        ]
        power = pairs.pop()
        while pairs:
            power = multiply_add(power, square, pairs.pop())
        integers = ir.VectorType(ir.IntType(bits), WIDTH)
        exponent = builder.shl(builder.fptosi(whole, integers), ir.Constant(integers, [mantissa] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(power, integers), exponent), power.type)

    return lanes(lanes), generate


@intrinsic
def _split(typing_context, lanes):
    """Mantissas in [1/2, 1) and exponents, as numbers, of normal positive lanes."""
    element = lanes.element
    bits, mantissa = (32, 23) if element == types.float32 else (64, 52)
    half = 126 if element == types.float32 else 1022

    def generate(context, builder, signature, arguments):
        integers = ir.VectorType(ir.IntType(bits), WIDTH)

        def constant(value):
            return ir.Constant(integers, [value] * WIDTH)

        raw = builder.bitcast(arguments[0], integers)
        exponent = builder.sub(builder.lshr(raw, constant(mantissa)), constant(half))
        inside = builder.or_(builder.and_(raw, constant((1 << mantissa) - 1)), constant(half << mantissa))
        parts = builder.bitcast(inside, arguments[0].type), builder.sitofp(exponent, arguments[0].type)
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(lanes, 2)(lanes), generate


@kernel(fast=True)
def log2(x):
    """Base-2 logarithm of positive normal lanes, within 2e-7 of itself or absolutely, in float32."""
    part, exponent = _split(x)
    small = part < SQRT_HALF
    part, exponent = where(small, part + part, part), where(small, exponent - 1, exponent)
    # ln(m) = 2 artanh((m - 1) / (m + 1)), whose series has odd terms only.
    ratio = (part - 1) / (part + 1)
    square = ratio * ratio
    total = square * 0 + 1 / 21
    for term in range(9, -1, -1):
        total = total * square + 1 / (2 * term + 1)
    return exponent + total * ratio * (2 / math.log(2))


@kernel(fast=True)
def exp(x):
    """e to the power of each lane, constant beyond 87 and -87."""
    return exp2(minimum(maximum(x * (1 / math.log(2)), -126), 126))
