"""Small perceptrons on the CPU: all layers of a tile of points in one go, forward and back.

Arrays are flat float32. Parameters lie one layer after the other, weights (outputs, inputs), then biases if there
are any. A layer's input is the output of the one before, at layer `again` followed by the net's own input once
more. Points go through in tiles whose activations stay in the first cache; rows are padded to whole vectors.
Backward, activations are computed again, and every piece of points sums gradients of its own: they are added up in
order, so that the result is the same for any number of threads.
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
    typing_context, a, a_at, a_row, a_step, b, b_at, b_step, count, base, base_at, base_row,
    gate, gate_at, gate_row, least, out, out_at, out_row,
):  # fmt: skip
    """out[out_at + r out_row + lane] = base[...] + sum over k < count of a[a_at + r a_row + k a_step] times
    b[b_at + k b_step + lane], for r < ROWS, lane < LANES; at least `least`, and 0 unless gate[...] is above 0."""

    def generate(context, builder, signature, arguments):
        def pointer(i):
            return context.make_array(signature.args[i])(context, builder, arguments[i]).data

        a_at, a_row, a_step, b_at, b_step, count = (arguments[i] for i in (1, 2, 3, 5, 6, 7))
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

        def vectors(i):
            start, at, row = pointer(i), arguments[i + 1], arguments[i + 2]
            places = (
                builder.gep(start, [builder.add(at, builder.mul(row, row.type(r)))]) for r in range(ROWS)
            )
            return [builder.bitcast(place, vector.as_pointer()) for place in places]

        left, right = pointer(0), pointer(4)
        sums = [cgutils.alloca_once_value(builder, builder.load(place, align=4)) for place in vectors(8)]
        with cgutils.for_range(builder, count) as loop:
            place = builder.gep(right, [builder.add(b_at, builder.mul(loop.index, b_step))])
            factor = builder.load(builder.bitcast(place, vector.as_pointer()), align=4)
            first = builder.add(a_at, builder.mul(loop.index, a_step))
            for r, total in enumerate(sums):
                place = builder.gep(left, [builder.add(first, builder.mul(a_row, a_row.type(r)))])
                number = everywhere(builder.load(place, align=4))
                builder.store(builder.call(fused, [number, factor, builder.load(total)]), total)
        floor, nothing = everywhere(arguments[14]), ir.Constant(vector, [0.0] * LANES)
        for total, gate, place in zip(sums, vectors(11), vectors(15), strict=True):
            value = builder.load(total)
            value = builder.select(builder.fcmp_ordered("<", value, floor), floor, value)  # NaN stays
            is_open = builder.fcmp_ordered(">", builder.load(gate, align=4), nothing)
            builder.store(builder.select(is_open, value, nothing), place, align=4)
        return context.get_dummy_value()

    three, two = [types.int64] * 3, [types.int64] * 2
    return types.none(a, *three, b, *three, base, *two, gate, *two, types.float32, out, *two), generate


@kernel()
def _multiply(
    rows, width, a, a_row, a_step, b, b_at, b_step, count, base, base_at, base_row, gate, gate_at, gate_row, least,
    out, out_at, out_row,
):  # fmt: skip
    """`_accumulate` for any number of rows and lanes, which are rounded up."""
    for lane in range(0, width, LANES):
        for r in range(0, rows, ROWS):
            _accumulate(
                a, r * a_row, a_row, a_step, b, b_at + lane, b_step, count,
                base, base_at + r * base_row + lane, base_row,
                gate, gate_at + r * gate_row + lane, gate_row, least, out, out_at + r * out_row + lane, out_row,
            )  # fmt: skip


@kernel()
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


@kernel()
def _copy(rows, width, of, of_at, of_row, to, to_at, to_row):
    for r in range(rows):
        for q in range(0, width, LANES):
            _move(of, of_at + r * of_row + q, to, to_at + r * to_row + q, width - q)


@kernel()
def _lay_out(sizes, widths, biased, parameters, starts):
    """Fills in `starts` (L + 1, 6), of each layer: where its weights, turned to (inputs, outputs padded), begin;
    its first parameter; where its tile of inputs (TILE, row) begins, and its row; where its padded biases begin;
    and its weights (outputs, inputs padded).

    Returns weights and biases, and the numbers that all tiles take.
    """
    layers = len(sizes) - 1
    place, parameter, tile = 0, 0, 0
    for layer in range(layers + 1):
        inputs, outputs = sizes[layer]
        wide, row = _padded(outputs), _padded(inputs)
        starts[layer, 0], starts[layer, 1], starts[layer, 2] = place, parameter, tile
        starts[layer, 3], starts[layer, 4] = _padded(widths[layer]), place + inputs * wide
        starts[layer, 5] = place + (inputs + 1) * wide
        place += (inputs + 1) * wide + outputs * row
        parameter += (inputs + biased) * outputs
        tile += TILE * starts[layer, 3]
    packed = np.zeros(place + LANES, np.float32)
    for layer in range(layers):
        inputs, outputs = sizes[layer]
        wide, row = _padded(outputs), _padded(inputs)
        first = starts[layer, 1]
        for o in range(outputs):
            for i in range(inputs):
                weight = parameters[first + o * inputs + i]
                packed[starts[layer, 0] + i * wide + o] = weight
                packed[starts[layer, 5] + o * row + i] = weight
            if biased:
                packed[starts[layer, 4] + o] = parameters[first + inputs * outputs + o]
    return packed, tile


@kernel()
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
    points, x_row, lead, extra_width, repeat, again, biased = numbers
    layers, none = len(sizes) - 1, sizes[-1, 1]  # 0: not a constant, for which numba would compile a copy
    step, whole = none + 1, none + TILE
    width, unbound = x_row - lead, np.float32(-np.inf)
    # What a layer's own tile holds: at `again` without the net's input, which is in the first.
    widths, starts = sizes[:, 0].copy(), np.empty((layers + 1, 6), np.int64)
    if again > 0:
        widths[again] = sizes[again - 1, 1]
    packed, room = _lay_out(sizes, widths, biased, parameters, starts)
    tiles, back = np.zeros(room, np.float32), len(g_out) > 0
    most, largest = 0, 0
    for layer in range(layers + 1):
        most = max(most, _padded(sizes[layer, 0]))
        largest = max(largest, _padded(sizes[layer, 1]))
    ones, zeros = np.ones(most, np.float32), np.zeros(most, np.float32)
    grads = np.empty((layers if back else 0, largest * most + LANES), np.float32)
    above, below = np.empty(TILE * most, np.float32), np.empty(TILE * most, np.float32)
    free = _padded(width)
    to_input = np.empty(TILE * free, np.float32)
    for piece in range(begin, end):
        grads[:] = 0
        biases = np.zeros((layers, most), np.float32)
        for first in range(piece * PIECE, min((piece + 1) * PIECE, points), TILE):
            count = min(whole, points - first)
            row = starts[0, 3]
            _copy(count, width, x, first * x_row + lead, x_row, tiles, none, row)
            for p in range(count):
                _copy(
                    step,
                    extra_width,
                    extra,
                    (first + p) // repeat * extra_width,
                    none,
                    tiles,
                    p * row + width,
                    none,
                )
            tiles[count * row : TILE * row] = 0
            for layer in range(layers):
                outputs, at, row = sizes[layer, 1], starts[layer + 1, 2], starts[layer + 1, 3]
                wide, least = _padded(outputs), np.float32(0) if layer + 1 < layers else unbound
                base, base_at, base_row, weights = packed, starts[layer, 4], none, starts[layer, 0]
                if layer > 0 and layer == again:
                    _multiply(
                        whole, outputs, tiles[:], starts[0, 3], step, packed, weights + widths[layer] * wide, wide,
                        sizes[0, 0], base, base_at, base_row, ones, none, none, unbound, tiles, at, row,
                    )  # fmt: skip
                    base, base_at, base_row = tiles, at, row
                _multiply(
                    whole, outputs, tiles[starts[layer, 2] :], starts[layer, 3], step, packed, weights, wide,
                    widths[layer], base, base_at, base_row, ones, none, none, least, tiles, at, row,
                )  # fmt: skip
            outputs, at, row = sizes[layers, 0], starts[layers, 2], starts[layers, 3]
            if not back:
                _copy(count, outputs, tiles, at, row, out, first * outputs, outputs)
                continue
            above[:] = 0
            _copy(count, outputs, g_out, first * outputs, outputs, above, none, most)
            to_input[:] = 0
            for layer in range(layers - 1, -1, -1):
                inputs, outputs, grad = sizes[layer, 0], sizes[layer, 1], grads[layer]
                at, tile_row, row, weights = (
                    starts[layer, 2],
                    starts[layer, 3],
                    _padded(inputs),
                    starts[layer, 5],
                )
                _multiply(
                    outputs, widths[layer], above, step, most, tiles, at, tile_row, count, grad, none, row,
                    ones, none, none, unbound, grad, none, row,
                )  # fmt: skip
                if layer > 0 and layer == again:
                    _multiply(
                        outputs, sizes[0, 0], above, step, most, tiles, none, starts[0, 3], count,
                        grad, widths[layer], row, ones, none, none, unbound, grad, widths[layer], row,
                    )  # fmt: skip
                for p in range(count * biased):
                    for q in range(outputs):
                        biases[layer, q] += above[p * most + q]
                if layer == 0 or layer == again:
                    _multiply(
                        count, width, above, most, step, packed,
                        weights + (none if layer == 0 else widths[layer]), row, outputs, to_input, none, free,
                        ones, none, none, unbound, to_input, none, free,
                    )  # fmt: skip
                if layer > 0:
                    _multiply(
                        count, widths[layer], above, most, step, packed, weights, row, outputs, zeros, none, none,
                        tiles, at, tile_row, unbound, below, none, most,
                    )  # fmt: skip
                above, below = below, above
            for p in range(count):
                for q in range(lead):
                    g_x[(first + p) * x_row + q] = 0
            _copy(count, width, to_input, none, free, g_x, first * x_row + lead, x_row)
        for layer in range(layers if back else 0):
            inputs, outputs = sizes[layer, 0], sizes[layer, 1]
            _copy(
                outputs, inputs, grads[layer], none, _padded(inputs), g_sums[piece], starts[layer, 1], inputs
            )
            if biased:
                _copy(
                    step,
                    outputs,
                    biases[layer],
                    none,
                    none,
                    g_sums[piece],
                    starts[layer, 1] + inputs * outputs,
                    none,
                )
