"""Small perceptrons on the CPU: all layers of a tile of points in one go, forward and back.

Arrays are flat float32; all that a call works on lies in one of them, `room`. Parameters lie one layer after the
other, weights (outputs, inputs), then biases if there are any. A layer's input is the output of the one before, at
layer `again` followed by the net's own input once more. Points go through in tiles whose activations stay in the
first cache; rows are padded to whole vectors. Backward, activations are computed again, and every piece of points
sums gradients of its own: they are added up in order, so that the result is the same for any number of threads.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import kernel

LANES, ROWS = 16, 8
"""What a call of `_accumulate` works on at least: two registers of 256 bits, or one of 512, for each of 8 rows."""
TWICE = "avx512f" in get_host_cpu_features()
"""Whether there are registers for twice as many lanes."""
TILE = 64
"""Points, a multiple of `ROWS`."""
STRIDE = 112
"""Between two points of a tile, whatever its width: a constant, so that rows need no registers of their own, and a
multiple of `LANES` that spreads them over the first cache."""
PIECE = 1024
"""Points whose gradients are summed before any others are added: a constant, whatever the number of threads."""


@intrinsic
def _accumulate(
    typing_context, room, vectors, turned, gated, a_at, b_at, b_step, count, base_at, base_row, gate_at, least,
    out_at, out_row,
):  # fmt: skip
    """Matrix product of `ROWS` rows and `LANES` lanes, or a multiple, within `room`, the sums in registers.

    room[out_at + r out_row + lane] = room[base_at + r base_row + lane] + sum over k < count of
    room[a_at + r STRIDE + k] room[b_at + k b_step + lane]; at least `least`, and, if gated, 0 unless
    room[gate_at + r STRIDE + lane] is above 0. Turned, the first factor is room[a_at + r + k STRIDE].
    `vectors` is a tuple as long as there are multiples of `LANES`; `turned`, `gated` are tuples, () for no.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        a_at, b_at, b_step, count, base_at, base_row, gate_at, least, out_at, out_row = arguments[4:]
        wide, is_turned, is_gated = (len(t) for t in signature.args[1:4])
        vector, index = ir.VectorType(ir.FloatType(), LANES), ir.IntType(32)
        undefined, zeros = (
            ir.Constant(vector, ir.Undefined),
            ir.Constant(ir.VectorType(index, LANES), [0] * LANES),
        )
        fused = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32"
        )

        def everywhere(number):
            one = builder.insert_element(undefined, number, index(0))
            return builder.shuffle_vector(one, undefined, zeros)

        def vectors_from(place):
            """The vectors of a row."""
            return [
                builder.bitcast(builder.gep(place, [b_at.type(LANES * v)]), vector.as_pointer())
                for v in range(wide)
            ]

        def vectors_of_rows(at, row):
            """Those of all rows, one row after the other."""
            places = [
                builder.gep(data, [builder.add(at, builder.mul(row, row.type(r)))]) for r in range(ROWS)
            ]
            return [place for row in places for place in vectors_from(row)]

        sums = [
            cgutils.alloca_once_value(builder, builder.load(place, align=4))
            for place in vectors_of_rows(base_at, base_row)
        ]
        with cgutils.for_range(builder, count) as loop:
            place = builder.gep(data, [builder.add(b_at, builder.mul(loop.index, b_step))])
            factors = [builder.load(v, align=4) for v in vectors_from(place)]
            step, to_row = (STRIDE, 1) if is_turned else (1, STRIDE)
            first = builder.gep(data, [builder.add(a_at, builder.mul(loop.index, a_at.type(step)))])
            for r in range(ROWS):
                number = everywhere(builder.load(builder.gep(first, [a_at.type(r * to_row)]), align=4))
                for factor, total in zip(factors, sums[r * wide : (r + 1) * wide], strict=True):
                    builder.store(builder.call(fused, [number, factor, builder.load(total)]), total)
        floor, nothing = everywhere(least), ir.Constant(vector, [0.0] * LANES)
        gates = vectors_of_rows(gate_at, gate_at.type(STRIDE)) if is_gated else [None] * len(sums)
        for total, gate, place in zip(sums, gates, vectors_of_rows(out_at, out_row), strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)  # NaN stays
            if gate is not None:
                is_open = builder.fcmp_ordered(">", builder.load(gate, align=4), nothing)
                value = builder.select(is_open, value, nothing)
            builder.store(value, place, align=4)
        return context.get_dummy_value()

    integer = types.int64
    scalars = [*[integer] * 7, types.float32, integer, integer]
    return types.none(room, vectors, turned, gated, *scalars), generate


@kernel(error_model="numpy")
def _multiply(
    rows,
    width,
    room,
    turned,
    gated,
    a_at,
    b_at,
    b_step,
    count,
    base_at,
    base_row,
    gate_at,
    least,
    out_at,
    out_row,
):
    """`_accumulate` for any number of rows and lanes, which are rounded up."""
    next_row = 1 if len(turned) else STRIDE
    for r in range(0, rows, ROWS):
        a, base, gate, out = (
            a_at + r * next_row,
            base_at + r * base_row,
            gate_at + r * STRIDE,
            out_at + r * out_row,
        )
        lane = 0 * width
        while lane < width:
            if TWICE and width - lane > LANES:
                _accumulate(
                    room, (0, 0), turned, gated, a, b_at + lane, b_step, count, base + lane, base_row, gate + lane,
                    least, out + lane, out_row,
                )  # fmt: skip
                lane += 2 * LANES
            else:
                _accumulate(
                    room, (0,), turned, gated, a, b_at + lane, b_step, count, base + lane, base_row, gate + lane,
                    least, out + lane, out_row,
                )  # fmt: skip
                lane += LANES


@kernel(error_model="numpy")
def _padded(n):
    return (n + LANES - 1) // LANES * LANES


@intrinsic
def _move(typing_context, of, of_at, to, to_at, count):
    """to[to_at + lane] = of[of_at + lane] for lane < min(count, LANES); touches nothing else."""

    def generate(context, builder, signature, arguments):
        vector, number = ir.VectorType(ir.FloatType(), LANES), ir.IntType(32)
        mask_type, pointer = ir.VectorType(ir.IntType(1), LANES), vector.as_pointer()
        one = builder.insert_element(
            ir.Constant(ir.VectorType(ir.IntType(64), LANES), ir.Undefined), arguments[4], number(0)
        )
        every = builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(number, LANES), [0] * LANES))
        lanes = ir.Constant(ir.VectorType(ir.IntType(64), LANES), list(range(LANES)))
        mask = builder.icmp_signed("<", lanes, every)
        places = []
        for i in (0, 2):
            data = context.make_array(signature.args[i])(context, builder, arguments[i]).data
            places.append(builder.bitcast(builder.gep(data, [arguments[i + 1]]), pointer))
        load = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(vector, [pointer, number, mask_type, vector]),
            f"llvm.masked.load.v{LANES}f32.p0",
        )
        store = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [vector, pointer, number, mask_type]),
            f"llvm.masked.store.v{LANES}f32.p0",
        )
        zero = ir.Constant(vector, [0.0] * LANES)
        builder.call(
            store, [builder.call(load, [places[0], number(4), mask, zero]), places[1], number(4), mask]
        )
        return context.get_dummy_value()

    return types.none(of, types.int64, to, types.int64, types.int64), generate


@kernel(error_model="numpy")
def _copy(rows, width, of, of_at, of_row, to, to_at, to_row):
    for r in range(rows):
        for q in range(0, width, LANES):
            _move(of, of_at + r * of_row + q, to, to_at + r * to_row + q, width - q)


@kernel(error_model="numpy")
def _lay_out(sizes, again, biased, places):
    """Fills in `places` (L + 1, 8), of each layer: how much of its input comes from the layer before; its first
    parameter; and where these begin: its weights turned to (inputs, outputs padded), its biases, its weights
    (outputs, inputs padded), the gradient of these (outputs padded, inputs padded), that of its biases, its tile
    (TILE, inputs from the layer before, up to STRIDE). Returns where the last ends."""
    at, parameter = 0, 0
    for layer in range(len(sizes)):
        inputs, outputs = sizes[layer, 0], sizes[layer, 1]
        wide, row = _padded(outputs), _padded(inputs)
        hidden = sizes[layer - 1, 1] if layer > 0 and layer == again else inputs
        places[layer, 0], places[layer, 1], places[layer, 2] = hidden, parameter, at
        places[layer, 3] = at + inputs * wide
        places[layer, 4] = places[layer, 3] + wide
        # Behind each matrix a vector to spare, over which a padded row may reach.
        places[layer, 5] = places[layer, 4] + outputs * row + LANES
        places[layer, 6] = places[layer, 5] + wide * row + LANES
        places[layer, 7] = places[layer, 6] + wide
        at = places[layer, 7] + TILE * STRIDE
        parameter += (inputs + biased) * outputs
    return at


@kernel(error_model="numpy")
def run(begin, end, numbers, sizes, parameters, x, extra, out, g_out, g_x, g_sums):
    """Runs pieces begin .. end - 1 of `PIECE` points.

    Args:
        numbers: (7,) points, numbers in a row of x and how many of these lead, in a row of extra and for how many
            points, `again` (-1 for none), whether there are biases.
        sizes: (L + 1, 2) inputs and outputs of each layer; the last row is (outputs of the net, 0).
        out: (points, outputs), comes out.
        g_out: its gradient, and then of out there is no need; empty for none.
        g_x: the gradient of x, comes out.
        g_sums: (pieces, parameters) the parameters' gradients by piece, come out.
    """
    points, x_row, lead = numbers[0], numbers[1], numbers[2]
    extra_width, repeat, again, biased = numbers[3], numbers[4], numbers[5], numbers[6]
    layers, zero = (
        len(sizes) - 1,
        sizes[-1, 1],
    )  # a mere 0 is a type of its own, and functions are compiled once more
    one, stride, width, back = zero + 1, zero + STRIDE, x_row - lead, len(g_out) > 0
    places = np.empty((layers + 1, 8), np.int64)
    zeros = _lay_out(sizes, again, biased, places)
    above, below, to_input = zeros + STRIDE, zeros + (1 + TILE) * STRIDE, zeros + (1 + 2 * TILE) * STRIDE
    room = np.empty(to_input + TILE * STRIDE + LANES, np.float32)
    room = room[-(room.ctypes.data // 4) % LANES :]  # vectors begin where lines of the cache do
    for i in range(len(room)):
        room[i] = 0
    unbound = np.float32(-np.inf)
    for layer in range(layers):
        inputs, outputs, at = sizes[layer, 0], sizes[layer, 1], places[layer, 1]
        for o in range(outputs):
            for i in range(inputs):
                room[places[layer, 2] + i * _padded(outputs) + o] = parameters[at + o * inputs + i]
        _copy(outputs, inputs, parameters, at, inputs, room, places[layer, 4], _padded(inputs))
        if biased:
            _copy(one, outputs, parameters, at + inputs * outputs, zero, room, places[layer, 3], zero)
    for piece in range(begin, end):
        for layer in range(layers if back else zero):
            gradients = room[places[layer, 5] : places[layer, 7]]
            for i in range(len(gradients)):
                gradients[i] = 0
        for first in range(piece * PIECE, min((piece + 1) * PIECE, points), TILE):
            count, at = min(zero + TILE, points - first), places[0, 7]
            _copy(count, width, x, first * x_row + lead, x_row, room, at, stride)
            p, of = zero, first // repeat
            while p < count and extra_width > 0:
                stop = min(count, (of + 1) * repeat - first)
                if repeat == 1:
                    stop = count
                _copy(
                    stop - p,
                    extra_width,
                    extra,
                    of * extra_width,
                    extra_width if repeat == 1 else zero,
                    room,
                    at + p * stride + width,
                    stride,
                )
                p, of = stop, of + 1
            for layer in range(layers):
                inputs, outputs, hidden = sizes[layer, 0], sizes[layer, 1], places[layer, 0]
                wide, to = _padded(outputs), places[layer + 1, 7]
                base, base_row, weights = places[layer, 3], zero, places[layer, 2]
                least = np.float32(0 if layer + 1 < layers else -np.inf)
                if hidden < inputs:
                    _multiply(
                        count, outputs, room, (), (), places[0, 7], weights + hidden * wide, wide, inputs - hidden,
                        base, base_row, zero, unbound, to, stride,
                    )  # fmt: skip
                    base, base_row = to, stride
                _multiply(
                    count, outputs, room, (), (), places[layer, 7], weights, wide, hidden, base, base_row, zero,
                    least, to, stride,
                )  # fmt: skip
            outputs, at = sizes[layers, 0], places[layers, 7]
            if not back:
                _copy(count, outputs, room, at, stride, out, first * outputs, outputs)
                continue
            _copy(count, outputs, g_out, first * outputs, outputs, room, above, stride)
            base, base_row = zeros, zero
            for layer in range(layers - 1, -1, -1):
                inputs, outputs, hidden = sizes[layer, 0], sizes[layer, 1], places[layer, 0]
                at, row, grad, weights = places[layer, 7], _padded(inputs), places[layer, 5], places[layer, 4]
                _multiply(
                    outputs,
                    hidden,
                    room,
                    (0,),
                    (),
                    above,
                    at,
                    stride,
                    count,
                    grad,
                    row,
                    zero,
                    unbound,
                    grad,
                    row,
                )
                if hidden < inputs:
                    _multiply(
                        outputs, inputs - hidden, room, (0,), (), above, places[0, 7], stride, count,
                        grad + hidden, row, zero, unbound, grad + hidden, row,
                    )  # fmt: skip
                for p in range(count if biased else zero):
                    for q in range(outputs):
                        room[places[layer, 6] + q] += room[above + p * STRIDE + q]
                if layer == 0 or hidden < inputs:
                    _multiply(
                        count, width, room, (), (), above, weights + (zero if layer == 0 else hidden), row,
                        outputs, base, base_row, zero, unbound, to_input, stride,
                    )  # fmt: skip
                    base, base_row = to_input, stride
                if layer > 0:
                    _multiply(
                        count, hidden, room, (), (0,), above, weights, row, outputs, zeros, zero, at, unbound,
                        below, stride,
                    )  # fmt: skip
                above, below = below, above
            for p in range(count):
                for q in range(lead):
                    g_x[(first + p) * x_row + q] = 0
            _copy(count, width, room, to_input, stride, g_x, first * x_row + lead, x_row)
        for layer in range(layers if back else zero):
            inputs, outputs = sizes[layer, 0], sizes[layer, 1]
            at = piece * len(parameters) + places[layer, 1]
            _copy(outputs, inputs, room, places[layer, 5], _padded(inputs), g_sums, at, inputs)
            if biased:
                _copy(one, outputs, room, places[layer, 6], zero, g_sums, at + inputs * outputs, zero)
