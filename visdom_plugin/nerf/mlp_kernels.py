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
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import kernel

LANES, ROWS = 16, 8
"""What one call of `_accumulate` works on: two registers of 256 bits, or one of 512, for each of eight rows."""
TILE = 64
"""Points, a multiple of `ROWS`."""
PIECE = 1024
"""Points whose gradients are summed before any others are added: a constant, whatever the number of threads."""


@intrinsic
def _accumulate(
    typing_context, room, a_at, a_row, a_step, b_at, b_step, count, base_at, base_row, gate_at, gate_row, least,
    out_at, out_row,
):  # fmt: skip
    """Matrix product of `ROWS` rows and `LANES` lanes within `room`, the sums in registers.

    room[out_at + r out_row + lane] = room[base_at + ...] + sum over k < count of room[a_at + r a_row + k a_step]
    room[b_at + k b_step + lane]; at least `least`, and 0 unless room[gate_at + ...] is above 0.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        (
            _,
            a_at,
            a_row,
            a_step,
            b_at,
            b_step,
            count,
            base_at,
            base_row,
            gate_at,
            gate_row,
            least,
            out_at,
            out_row,
        ) = arguments
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

        def vectors(at, row):
            places = (
                builder.gep(data, [builder.add(at, builder.mul(row, row.type(r)))]) for r in range(ROWS)
            )
            return [builder.bitcast(place, vector.as_pointer()) for place in places]

        sums = [
            cgutils.alloca_once_value(builder, builder.load(place, align=4))
            for place in vectors(base_at, base_row)
        ]
        with cgutils.for_range(builder, count) as loop:
            place = builder.gep(data, [builder.add(b_at, builder.mul(loop.index, b_step))])
            factor = builder.load(builder.bitcast(place, vector.as_pointer()), align=4)
            first = builder.add(a_at, builder.mul(loop.index, a_step))
            for r, total in enumerate(sums):
                place = builder.gep(data, [builder.add(first, builder.mul(a_row, a_row.type(r)))])
                number = everywhere(builder.load(place, align=4))
                builder.store(builder.call(fused, [number, factor, builder.load(total)]), total)
        floor, nothing = everywhere(least), ir.Constant(vector, [0.0] * LANES)
        for total, gate, place in zip(
            sums, vectors(gate_at, gate_row), vectors(out_at, out_row), strict=True
        ):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)  # NaN stays
            is_open = builder.fcmp_ordered(">", builder.load(gate, align=4), nothing)
            builder.store(builder.select(is_open, value, nothing), place, align=4)
        return context.get_dummy_value()

    integer = types.int64
    return types.none(room, *[integer] * 10, types.float32, integer, integer), generate


@kernel(error_model="numpy")
def _multiply(
    rows, width, room, a_at, a_row, a_step, b_at, b_step, count, base_at, base_row, gate_at, gate_row, least,
    out_at, out_row,
):  # fmt: skip
    """`_accumulate` for any number of rows and lanes, which are rounded up."""
    for lane in range(0, width, LANES):
        for r in range(0, rows, ROWS):
            _accumulate(
                room, a_at + r * a_row, a_row, a_step, b_at + lane, b_step, count, base_at + r * base_row + lane,
                base_row, gate_at + r * gate_row + lane, gate_row, least, out_at + r * out_row + lane, out_row,
            )  # fmt: skip


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
    (TILE, inputs from the layer before, padded). Returns where the last ends."""
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
        at = places[layer, 7] + TILE * _padded(hidden)
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
    one, whole, width, back = zero + 1, zero + TILE, x_row - lead, len(g_out) > 0
    places = np.empty((layers + 1, 8), np.int64)
    ones = _lay_out(sizes, again, biased, places)
    most = zero
    for layer in range(layers + 1):
        most = max(most, _padded(sizes[layer, 0]))
    free = _padded(width)
    zeros = ones + most
    above, below, to_input = zeros + most, zeros + most + TILE * most, zeros + most + 2 * TILE * most
    room = np.zeros(to_input + TILE * free + LANES, np.float32)
    room[ones:zeros] = 1
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
            room[places[layer, 5] : places[layer, 7]] = 0
        for first in range(piece * PIECE, min((piece + 1) * PIECE, points), TILE):
            count, at, row = min(whole, points - first), places[0, 7], _padded(sizes[0, 0])
            _copy(count, width, x, first * x_row + lead, x_row, room, at, row)
            for p in range(count):
                of = (first + p) // repeat * extra_width
                _copy(one, extra_width, extra, of, zero, room, at + p * row + width, zero)
            room[at + count * row : at + TILE * row] = 0
            for layer in range(layers):
                inputs, outputs, hidden = sizes[layer, 0], sizes[layer, 1], places[layer, 0]
                wide, to, to_row = _padded(outputs), places[layer + 1, 7], _padded(places[layer + 1, 0])
                base, base_row, weights = places[layer, 3], zero, places[layer, 2]
                least = np.float32(0 if layer + 1 < layers else -np.inf)
                if hidden < inputs:
                    _multiply(
                        whole, outputs, room, places[0, 7], row, one, weights + hidden * wide, wide,
                        inputs - hidden, base, base_row, ones, zero, np.float32(-np.inf), to, to_row,
                    )  # fmt: skip
                    base, base_row = to, to_row
                _multiply(
                    whole, outputs, room, places[layer, 7], _padded(hidden), one, weights, wide, hidden,
                    base, base_row, ones, zero, least, to, to_row,
                )  # fmt: skip
            outputs, at = sizes[layers, 0], places[layers, 7]
            if not back:
                _copy(count, outputs, room, at, _padded(outputs), out, first * outputs, outputs)
                continue
            room[above : above + TILE * most] = 0
            _copy(count, outputs, g_out, first * outputs, outputs, room, above, most)
            room[to_input : to_input + TILE * free] = 0
            for layer in range(layers - 1, -1, -1):
                inputs, outputs, hidden = sizes[layer, 0], sizes[layer, 1], places[layer, 0]
                at, tile_row, to_row = places[layer, 7], _padded(hidden), _padded(inputs)
                grad, weights, unbound = places[layer, 5], places[layer, 4], np.float32(-np.inf)
                _multiply(
                    outputs, hidden, room, above, one, most, at, tile_row, count, grad, to_row, ones, zero,
                    unbound, grad, to_row,
                )  # fmt: skip
                if hidden < inputs:
                    _multiply(
                        outputs, inputs - hidden, room, above, one, most, places[0, 7], row, count,
                        grad + hidden, to_row, ones, zero, unbound, grad + hidden, to_row,
                    )  # fmt: skip
                for p in range(count if biased else zero):
                    for q in range(outputs):
                        room[places[layer, 6] + q] += room[above + p * most + q]
                if layer == 0 or hidden < inputs:
                    _multiply(
                        count, width, room, above, most, one, weights + (zero if layer == 0 else hidden), to_row,
                        outputs, to_input, free, ones, zero, unbound, to_input, free,
                    )  # fmt: skip
                if layer > 0:
                    _multiply(
                        count, hidden, room, above, most, one, weights, to_row, outputs, zeros, zero, at, tile_row,
                        unbound, below, most,
                    )  # fmt: skip
                above, below = below, above
            for p in range(count):
                for q in range(lead):
                    g_x[(first + p) * x_row + q] = 0
            _copy(count, width, room, to_input, free, g_x, first * x_row + lead, x_row)
        for layer in range(layers if back else zero):
            inputs, outputs = sizes[layer, 0], sizes[layer, 1]
            at = piece * len(parameters) + places[layer, 1]
            _copy(outputs, inputs, room, places[layer, 5], _padded(inputs), g_sums, at, inputs)
            if biased:
                _copy(one, outputs, room, places[layer, 6], zero, g_sums, at + inputs * outputs, zero)
