"""The hash encoding and its gradient as numba kernels.

Points go through in blocks. For a block and a level, the rows and weights of all eight corners are written to
two scratch arrays of eight planes, in loops without branches, which vectorise; a second loop then gathers from the
table, or scatters into its gradient. Corner c has x + 1 where bit 0 of c is set, y + 1 for bit 1, z + 1 for bit 2.

Arrays are flat. Points come in groups of S = `samples` whose features are added up: points (groups * S * 3),
table (rows * features), encoded (groups * levels * features). `scales` (groups * S) holds the standard deviation
of each point, or nothing: then points are not weighted.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import kernel

SUMMED = 1024
"""Squares summed in float32 at a time."""
BLOCK = 256
"""Points per block, at most; groups are not divided."""
PLANE = BLOCK + 16
"""Length of a plane: a constant, else nothing would vectorise, and no power of two, for the sake of the caches."""

U, W = np.uint64, np.uint32
# Numba widens every result to 64 bits: indices are unsigned, so that they are not tested for being negative, and
# hashes are cut back to 32 bits after each operation, so that twice as many fit into a vector.


@kernel(fast=True)
def _erf(x):
    """erf of x >= 0 within 1e-6 relative, at most 1: x P(x^2) / Q(x^2), fitted for least relative error."""
    real = np.float32
    x = min(x, real(4))
    t = x * x
    p = real(0.0003361518611200154)
    p = p * t + real(0.00953626073896885)
    p = p * t + real(0.07072417438030243)
    p = p * t + real(0.3359927833080292)
    p = p * t + real(1.1283787488937378)
    q = real(1.9290611817268655e-05)
    q = q * t + real(0.0024049589410424232)
    q = q * t + real(0.02674618735909462)
    q = q * t + real(0.17309436202049255)
    q = q * t + real(0.631088376045227)
    q = q * t + real(1)
    return min(x * p / q, real(1))


@kernel(fast=True)
def _weigh(scales, first, count, resolution, strengths):
    """strengths[p] = erf(1 / (sqrt(8) scale resolution)) of points first .. first + count - 1."""
    factor = np.float32(1) / (np.float32(math.sqrt(8)) * np.float32(resolution))
    for p in range(U(count)):
        strengths[p] = _erf(factor / scales[U(first) + p])


@kernel(fast=True)
def _locate(points, first, count, resolution, dense, mask, offset, strengths, rows, weights):
    """Rows and weights (8 planes) of points first .. first + count - 1. NaN counts as 0."""
    zero, one = np.float32(0), np.float32(1)
    r, top, plane = np.float32(resolution), np.int32(resolution - 1), U(PLANE)
    if dense:
        step_y, step_z = W(resolution + 1), W((resolution + 1) * (resolution + 1))
    else:
        step_y, step_z = W(2654435761), W(805459861)
    m, o = W(mask), W(offset)
    for p in range(U(count)):
        at = U(3) * (U(first) + p)
        x, y, z = points[at], points[at + U(1)], points[at + U(2)]
        x, y, z = (x if x > zero else zero), (y if y > zero else zero), (z if z > zero else zero)
        x, y, z = min(x, one) * r, min(y, one) * r, min(z, one) * r
        i, j, k = min(np.int32(x), top), min(np.int32(y), top), min(np.int32(z), top)
        x1, y1, z1 = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        x0, y0, z0 = one - x1, one - y1, one - z1
        s = strengths[p]
        z0, z1 = s * z0, s * z1
        w0, w1, w2, w3 = y0 * z0, y1 * z0, y0 * z1, y1 * z1
        weights[p] = x0 * w0
        weights[p + plane] = x1 * w0
        weights[p + U(2) * plane] = x0 * w1
        weights[p + U(3) * plane] = x1 * w1
        weights[p + U(4) * plane] = x0 * w2
        weights[p + U(5) * plane] = x1 * w2
        weights[p + U(6) * plane] = x0 * w3
        weights[p + U(7) * plane] = x1 * w3
        i0, i1 = W(i), W(W(i) + W(1))
        j0, k0 = W(W(j) * step_y), W(W(k) * step_z)
        j1, k1 = W(j0 + step_y), W(k0 + step_z)
        if dense:
            k0, k1 = W(k0 + o), W(k1 + o)
            a, b, c, d = W(j0 + k0), W(j1 + k0), W(j0 + k1), W(j1 + k1)
            rows[p] = W(i0 + a)
            rows[p + plane] = W(i1 + a)
            rows[p + U(2) * plane] = W(i0 + b)
            rows[p + U(3) * plane] = W(i1 + b)
            rows[p + U(4) * plane] = W(i0 + c)
            rows[p + U(5) * plane] = W(i1 + c)
            rows[p + U(6) * plane] = W(i0 + d)
            rows[p + U(7) * plane] = W(i1 + d)
        else:
            a, b, c, d = W(j0 ^ k0), W(j1 ^ k0), W(j0 ^ k1), W(j1 ^ k1)
            rows[p] = W(W(W(i0 ^ a) & m) + o)
            rows[p + plane] = W(W(W(i1 ^ a) & m) + o)
            rows[p + U(2) * plane] = W(W(W(i0 ^ b) & m) + o)
            rows[p + U(3) * plane] = W(W(W(i1 ^ b) & m) + o)
            rows[p + U(4) * plane] = W(W(W(i0 ^ c) & m) + o)
            rows[p + U(5) * plane] = W(W(W(i1 ^ c) & m) + o)
            rows[p + U(6) * plane] = W(W(W(i0 ^ d) & m) + o)
            rows[p + U(7) * plane] = W(W(W(i1 ^ d) & m) + o)


@kernel(fast=True)
def _locate_level(points, first, count, resolution, dense, mask, offset, strengths, rows, weights):
    """`_locate` with `dense` a constant in each of two copies."""
    if dense:
        _locate(points, first, count, resolution, True, mask, offset, strengths, rows, weights)
    else:
        _locate(points, first, count, resolution, False, mask, offset, strengths, rows, weights)


def _emit_corners(context, builder, signature, arguments, body):
    """Emits `body(pointer to a row's features, weight in every lane)` for each of a point's eight corners.

    The arguments are those of the two intrinsics below. `lanes` is a tuple as long as there are lanes:
    its type carries their number.
    """
    table, rows, weights = (
        context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 2, 3)
    )
    lanes = len(signature.args[1])
    _, row_at, stride, p = arguments[5:]
    vector = ir.VectorType(ir.FloatType(), lanes)
    for corner in range(8):
        place = builder.add(p, p.type(corner * PLANE))
        row = builder.zext(builder.load(builder.gep(rows, [place])), p.type)
        first = builder.gep(table, [builder.add(builder.mul(row, stride), row_at)])
        weight, spread_out = builder.load(builder.gep(weights, [place])), ir.Constant(vector, ir.Undefined)
        for lane in range(lanes):
            spread_out = builder.insert_element(spread_out, weight, ir.IntType(32)(lane))
        body(builder.bitcast(first, vector.as_pointer()), spread_out)


def _vector_at(context, builder, signature, arguments):
    """Pointer to the point's own features, as a vector."""
    encoded = context.make_array(signature.args[4])(context, builder, arguments[4]).data
    vector = ir.VectorType(ir.FloatType(), len(signature.args[1]))
    return builder.bitcast(builder.gep(encoded, [arguments[5]]), vector.as_pointer())


@intrinsic
def _interpolate(typing_context, table, lanes, rows, weights, out, at, row_at, stride, p, count):
    """out[at + lane] = sum over points p .. p + count - 1 and their corners of weight times table[row * stride +
    row_at + lane], as one vector."""

    def generate(context, builder, signature, arguments):
        *arguments, count = arguments
        vector = ir.VectorType(ir.FloatType(), len(signature.args[1]))
        total = cgutils.alloca_once_value(builder, ir.Constant(vector, [0.0] * vector.count))
        with cgutils.for_range(builder, count) as loop:
            products = []

            def add(pointer, weight):
                products.append(builder.fmul(weight, builder.load(pointer, align=4), flags=("contract",)))

            point = builder.add(arguments[-1], loop.index)
            _emit_corners(context, builder, signature, [*arguments[:-1], point], add)
            while len(products) > 1:  # in pairs: one sum after another would wait for the one before
                pairs = zip(products[::2], products[1::2], strict=True)
                products = [builder.fadd(a, b, flags=("contract",)) for a, b in pairs]
            builder.store(builder.fadd(builder.load(total), products[0], flags=("contract",)), total)
        builder.store(builder.load(total), _vector_at(context, builder, signature, arguments), align=4)
        return context.get_dummy_value()

    return types.none(table, lanes, rows, weights, out, *[types.uint64] * 5), generate


@intrinsic
def _distribute(typing_context, table, lanes, rows, weights, source, at, row_at, stride, p):
    """table[row * stride + row_at + lane] += weight * source[at + lane] for each corner, lanes as a vector."""

    def generate(context, builder, signature, arguments):
        gradient = builder.load(_vector_at(context, builder, signature, arguments), align=4)

        def add(pointer, weight):
            product = builder.fmul(weight, gradient, flags=("contract",))
            total = builder.fadd(builder.load(pointer, align=4), product, flags=("contract",))
            builder.store(total, pointer, align=4)

        _emit_corners(context, builder, signature, arguments, add)
        return context.get_dummy_value()

    return types.none(table, lanes, rows, weights, source, *[types.uint64] * 4), generate


@kernel(fast=True)
def _gather(table, lanes, features, rows, weights, samples, groups, out, at, stride):
    """out[at + g stride + f] = sum over the group's points and their corners of weight * table[row, f]."""
    wide = U(features)
    for g in range(U(groups)):
        to = U(at) + g * U(stride)
        for f in range(U(0), wide, U(len(lanes))):
            _interpolate(table, lanes, rows, weights, out, to + f, f, wide, g * U(samples), U(samples))


@kernel(fast=True)
def _scatter(g_table, lanes, features, rows, weights, samples, groups, g_out, at, stride):
    """The transpose of `_gather`: adds to the table's gradient, in the order of the points."""
    wide = U(features)
    for g in range(U(groups)):
        source = U(at) + g * U(stride)
        for p in range(g * U(samples), (g + U(1)) * U(samples)):
            for f in range(U(0), wide, U(len(lanes))):
                _distribute(g_table, lanes, rows, weights, g_out, source + f, f, wide, p)


@kernel(error_model="numpy")
def encode(
    begin, end, samples, points, scales, table, features,
    resolutions, dense, masks, offsets, spans, out, mean_strengths,
):  # fmt: skip
    """Encodes items begin .. end - 1: item = level * blocks + block, so that neighbours share a level's table.

    Writes out (groups, levels, features) and, if there are scales, mean_strengths (groups, levels): numbers w in
    [0, 1], or, with spans (levels,), (2 w - 1) times the level's.
    """
    levels = len(resolutions)
    groups = len(points) // (3 * samples)
    groups_per_block = BLOCK // samples
    blocks = (groups + groups_per_block - 1) // groups_per_block
    rows, weights = np.empty(8 * PLANE, np.uint32), np.empty(8 * PLANE, np.float32)
    strengths = np.empty(BLOCK, np.float32)
    for p in range(BLOCK):
        strengths[p] = 1
    share = np.float32(1) / np.float32(samples)
    stride = levels * features
    for item in range(begin, end):
        level, first = item // blocks, (item % blocks) * groups_per_block
        count = min(groups_per_block, groups - first)
        if len(scales):
            _weigh(scales, first * samples, count * samples, resolutions[level], strengths)
            for g in range(count):
                total = np.float32(0)
                for p in range(g * samples, (g + 1) * samples):
                    total += strengths[p]
                    strengths[p] *= share
                mean = total / np.float32(samples)
                if len(spans):
                    mean = (np.float32(2) * mean - np.float32(1)) * spans[level]
                mean_strengths[(first + g) * levels + level] = mean
        _locate_level(
            points, first * samples, count * samples, resolutions[level], dense[level], masks[level],
            offsets[level], strengths, rows, weights,
        )  # fmt: skip
        at = first * stride + level * features
        if features == 1:
            _gather(table, (0,), 1, rows, weights, samples, count, out, at, stride)
        elif features == 2:
            _gather(table, (0, 0), 2, rows, weights, samples, count, out, at, stride)
        elif features == 4:
            _gather(table, (0, 0, 0, 0), 4, rows, weights, samples, count, out, at, stride)
        else:
            _gather(table, (0,), features, rows, weights, samples, count, out, at, stride)


@kernel(error_model="numpy")
def encode_backward(
    begin, end, samples, points, scales, g_out, features,
    resolutions, dense, masks, offsets, table, decay, g_table,
):  # fmt: skip
    """Writes the table's gradient of `end - begin` levels, the finest first: item 0 is the last level. With decay
    (levels,) the level's number times the table is added."""
    levels = len(resolutions)
    groups = len(points) // (3 * samples)
    groups_per_block = BLOCK // samples
    rows, weights = np.empty(8 * PLANE, np.uint32), np.empty(8 * PLANE, np.float32)
    strengths = np.empty(BLOCK, np.float32)
    for p in range(BLOCK):
        strengths[p] = 1
    share = np.float32(1) / np.float32(samples)
    stride = levels * features
    for item in range(begin, end):
        level = levels - 1 - item
        for i in range(U(offsets[level] * features), U(offsets[level + 1] * features)):
            g_table[i] = 0
        for first in range(0, groups, groups_per_block):
            count = min(groups_per_block, groups - first)
            if len(scales):
                _weigh(scales, first * samples, count * samples, resolutions[level], strengths)
                for p in range(count * samples):
                    strengths[p] *= share
            _locate_level(
                points, first * samples, count * samples, resolutions[level], dense[level], masks[level],
                offsets[level], strengths, rows, weights,
            )  # fmt: skip
            at = first * stride + level * features
            if features == 1:
                _scatter(g_table, (0,), 1, rows, weights, samples, count, g_out, at, stride)
            elif features == 2:
                _scatter(g_table, (0, 0), 2, rows, weights, samples, count, g_out, at, stride)
            elif features == 4:
                _scatter(g_table, (0, 0, 0, 0), 4, rows, weights, samples, count, g_out, at, stride)
            else:
                _scatter(g_table, (0,), features, rows, weights, samples, count, g_out, at, stride)
        if len(decay):
            for i in range(offsets[level] * features, offsets[level + 1] * features):
                g_table[i] += decay[level] * table[i]


@kernel(fast=True)
def _sum_squares(values, first, last):
    total = np.float32(0)
    for i in range(first, last):
        total += values[i] * values[i]
    return total


@kernel(error_model="numpy")
def mean_squares(begin, end, table, features, offsets, out):
    """Means (levels,) of a table's squared features; item 0 is the last level. Sums of blocks are added up in
    float64, so that they are exact enough."""
    levels = len(out)
    for level in range(levels - end, levels - begin):
        first, last = offsets[level] * features, offsets[level + 1] * features
        total = 0.0
        for block in range(first, last, SUMMED):
            total += _sum_squares(table, block, min(block + SUMMED, last))
        out[level] = total / (last - first)
