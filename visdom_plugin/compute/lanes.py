"""Vectors of 16 numbers for kernels, one row of a tile at a time.

A compiler may find the vectors in a loop or not, and says nothing when it does not. Here a kernel names them: it
loads 16 numbers, calculates with operators as with one, and stores them. Operations keep their order; only a
product and the sum that takes it up may become one instruction.

Calculations mix vectors with plain numbers, which are rounded to the vector's precision first. Comparisons give
16 truth values, which `&` joins and `where` and `any_of` take.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH = 16


class LanesType(types.Type):
    """16 numbers or truth values of one kind."""

    def __init__(self, element: Any):
        self.element = element
        super().__init__(name=f"Lanes({element})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: LanesType):
        super().__init__(manager, lanes, vector_of(lanes.element))


def scalar_of(element: Any) -> ir.Type:
    if element == types.boolean:
        return ir.IntType(1)
    return ir.FloatType() if element == types.float32 else ir.DoubleType()


def vector_of(element: Any) -> ir.VectorType:
    return ir.VectorType(scalar_of(element), WIDTH)


def constant_of(element: Any, values: list[float]) -> ir.Constant:
    return ir.Constant(vector_of(element), [ir.Constant(scalar_of(element), v) for v in values])


def _shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(picks)), picks))


def _spread(builder: Any, number: Any) -> Any:
    first = builder.insert_element(
        ir.Constant(ir.VectorType(number.type, WIDTH), ir.Undefined), number, ir.Constant(ir.IntType(32), 0)
    )
    return _shuffle(builder, first, first, [0] * WIDTH)


def call_each(builder: Any, name: str, *arguments: Any) -> Any:
    kind = arguments[0].type
    letter = "f32" if kind.element == ir.FloatType() else "f64"
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(kind, [kind] * len(arguments)), f"llvm.{name}.v{WIDTH}{letter}"
    )
    return builder.call(function, arguments)


# Operators: what numba infers and how it is lowered, each from one line of a table.

ARITHMETIC: dict[Callable[..., Any], Callable[[Any, Any, Any], Any]] = {
    operator.add: lambda b, x, y: b.fadd(x, y, flags=("contract",)),
    operator.sub: lambda b, x, y: b.fsub(x, y, flags=("contract",)),
    operator.mul: lambda b, x, y: b.fmul(x, y, flags=("contract",)),
    operator.truediv: lambda b, x, y: b.fdiv(x, y, flags=("contract",)),
}
COMPARISONS: dict[Callable[..., Any], str] = {
    operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=",
}  # fmt: skip


def _element_of(arguments: tuple[Any, ...]) -> Any:
    """Of lanes of one precision mixed with numbers; None for anything else."""
    elements = {a.element for a in arguments if isinstance(a, LanesType)}
    known = all(isinstance(a, LanesType | types.Float | types.Integer) for a in arguments)
    return elements.pop() if known and len(arguments) == 2 and len(elements) == 1 else None


def _operands(context: Any, builder: Any, kinds: Any, arguments: Any, element: Any) -> list[Any]:
    return [
        a if isinstance(kind, LanesType) else _spread(builder, context.cast(builder, a, kind, element))
        for kind, a in zip(kinds, arguments, strict=True)
    ]


def _register(function: Any, emit: Callable[[Any, Any, Any], Any], to: Callable[[Any], Any]) -> None:
    @infer_global(function)
    class _Template(AbstractTemplate):
        metadata = {"target": "cpu"}  # noqa: RUF012 (numba's); tried first, see kernels.py

        def generic(self, arguments: Any, keywords: Any) -> Any:
            element = _element_of(arguments)
            result = None if element is None else to(element)
            return None if result is None else signature(LanesType(result), *arguments)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return emit(builder, *_operands(context, builder, sig.args, arguments, _element_of(sig.args)))

    for number in (types.Float, types.Integer):
        lower_builtin(function, LanesType, number)(lower)
        lower_builtin(function, number, LanesType)(lower)
    lower_builtin(function, LanesType, LanesType)(lower)


def _number(element: Any) -> Any:
    return element if element != types.boolean else None


def _compare(sign: str, builder: Any, x: Any, y: Any) -> Any:
    return builder.fcmp_ordered(sign, x, y)


for _function, _emit in ARITHMETIC.items():
    _register(_function, _emit, _number)
for _function, _sign in COMPARISONS.items():
    _register(_function, partial(_compare, _sign), lambda e: types.boolean if e != types.boolean else None)
_register(operator.and_, lambda b, x, y: b.and_(x, y), lambda e: e if e == types.boolean else None)


@intrinsic
def fill(typing_context, number):
    """16 times a number."""
    _ = ARITHMETIC, COMPARISONS, _compare  # so that a cached kernel is compiled anew when they change

    def generate(context, builder, signature, arguments):
        return _spread(builder, arguments[0])

    return LanesType(number)(number), generate


@intrinsic
def count_up(typing_context, number):
    """number, number + 1, ..., number + 15."""

    def generate(context, builder, signature, arguments):
        steps = constant_of(number, [float(i) for i in range(WIDTH)])
        return builder.fadd(_spread(builder, arguments[0]), steps)

    return LanesType(number)(number), generate


def _place(context: Any, builder: Any, array: Any, value: Any, index: Any) -> Any:
    data = context.make_array(array)(context, builder, value).data
    first = builder.gep(data, [index])
    return builder.bitcast(first, vector_of(array.dtype).as_pointer())


@intrinsic
def load(typing_context, array, index):
    """Numbers index .. index + 15 of a contiguous array, counted through all its dimensions. Not bound checked."""

    def generate(context, builder, signature, arguments):
        out = builder.load(_place(context, builder, array, *arguments))
        out.align = context.get_abi_sizeof(scalar_of(array.dtype))
        return out

    return LanesType(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing_context, array, index, lanes):
    """Writes numbers index .. index + 15 of a contiguous array. Not bound checked."""

    def generate(context, builder, signature, arguments):
        place = _place(context, builder, array, *arguments[:2])
        builder.store(arguments[2], place, align=context.get_abi_sizeof(scalar_of(array.dtype)))
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


def _each(context: Any, builder: Any, array: Any, value: Any, first: Any, step: Any) -> list[Any]:
    """Pointers to numbers first, first + step, ... of an array."""
    data = context.make_array(array)(context, builder, value).data
    steps = [builder.mul(step, ir.Constant(step.type, lane)) for lane in range(WIDTH)]
    return [builder.gep(data, [builder.add(first, s)]) for s in steps]


@intrinsic
def take(typing_context, array, index, step):
    """Numbers index, index + step, ... of a contiguous array. Not bound checked."""

    def generate(context, builder, signature, arguments):
        out = ir.Constant(vector_of(array.dtype), ir.Undefined)
        for lane, place in enumerate(_each(context, builder, array, *arguments)):
            out = builder.insert_element(out, builder.load(place), ir.Constant(ir.IntType(32), lane))
        return out

    return LanesType(array.dtype)(array, types.intp, types.intp), generate


@intrinsic
def put(typing_context, array, index, step, lanes):
    """Writes numbers index, index + step, ... of a contiguous array, of integers too. Not bound checked."""

    def generate(context, builder, signature, arguments):
        for lane, place in enumerate(_each(context, builder, array, *arguments[:3])):
            number = builder.extract_element(arguments[3], ir.Constant(ir.IntType(32), lane))
            builder.store(context.cast(builder, number, lanes.element, array.dtype), place)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes), generate


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Columns of 16 vectors: blocks of two of them change places, four times, of 1, 2, 4 and 8 numbers."""
    for block in (1, 2, 4, 8):
        low = [i if not i & block else WIDTH + i - block for i in range(WIDTH)]
        high = [i + block if not i & block else WIDTH + i for i in range(WIDTH)]
        pairs = [(i, i + block) for i in range(WIDTH) if not i & block]
        for i, j in pairs:
            rows[i], rows[j] = (_shuffle(builder, rows[i], rows[j], picks) for picks in (low, high))
    return rows


@intrinsic
def transpose(typing_context, array, index, step, out, at, out_step):
    """Writes rows of 16 numbers at index, index + step, ... of an array as columns: to `at`, at + out_step, ...

    Both arrays are contiguous; not bound checked.
    """

    def generate(context, builder, signature, arguments):
        kind = vector_of(array.dtype).as_pointer()
        size = context.get_abi_sizeof(scalar_of(array.dtype))
        rows = []
        for place in _each(context, builder, array, *arguments[:3]):
            rows.append(builder.load(builder.bitcast(place, kind)))
            rows[-1].align = size
        places = _each(context, builder, out, *arguments[3:])
        for place, column in zip(places, _transposed(builder, rows), strict=True):
            builder.store(column, builder.bitcast(place, kind), align=size)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, out, types.intp, types.intp), generate


@intrinsic
def store_all(typing_context, array, index, vectors):
    """Writes a tuple of vectors one behind the other. Not bound checked."""

    def generate(context, builder, signature, arguments):
        for k, vector in enumerate(cgutils.unpack_tuple(builder, arguments[2])):
            at = builder.add(arguments[1], ir.Constant(arguments[1].type, WIDTH * k))
            place = _place(context, builder, array, arguments[0], at)
            builder.store(vector, place, align=context.get_abi_sizeof(scalar_of(array.dtype)))
        return context.get_dummy_value()

    return types.void(array, types.intp, vectors), generate


@intrinsic
def where(typing_context, condition, yes, no):
    """`yes` where a condition holds, else `no`; one of them may be a number."""
    element = _element_of((yes, no))
    if element is None:
        return None

    def generate(context, builder, signature, arguments):
        chosen = _operands(context, builder, (yes, no), arguments[1:], element)
        return builder.select(arguments[0], *chosen)

    return LanesType(element)(condition, yes, no), generate


@intrinsic
def any_of(typing_context, condition):
    """Whether any of 16 truth values holds."""

    def generate(context, builder, signature, arguments):
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(condition), generate


def _bounded(sign: str) -> Callable[..., Any]:
    def intrinsic_for(typing_context, lanes, bound):
        element = _element_of((lanes, bound))

        def generate(context, builder, signature, arguments):
            x, limit = _operands(context, builder, (lanes, bound), arguments, element)
            return builder.select(builder.fcmp_ordered(sign, x, limit), x, limit)

        return None if element is None else (lanes(lanes, bound), generate)

    return intrinsic_for


minimum = intrinsic(_bounded("<"))
"""The smaller of each lane and a number or another vector's lane; where the first is NaN, the second."""
maximum = intrinsic(_bounded(">"))
"""The larger of each lane and a number or another vector's lane; where the first is NaN, the second."""


def _rounded(name: str) -> Callable[..., Any]:
    def intrinsic_for(typing_context, lanes):
        def generate(context, builder, signature, arguments):
            return call_each(builder, name, arguments[0])

        return lanes(lanes), generate

    return intrinsic_for


sqrt = intrinsic(_rounded("sqrt"))
"""Square root of each lane."""
floor = intrinsic(_rounded("floor"))
"""Each lane rounded down."""
ceil = intrinsic(_rounded("ceil"))
"""Each lane rounded up."""


@intrinsic
def multiply_add(typing_context, x, y, z):
    """x y + z, rounded once; `x * y + z` may be rounded once or twice, by the code around it."""

    def generate(context, builder, signature, arguments):
        return call_each(builder, "fma", *arguments)

    return x(x, x, x), generate


@intrinsic
def totals(typing_context, vectors):
    """Sums over the lanes of up to 16 vectors, given as a tuple: that of vector k in lane k, zero behind.

    Halves of two vectors are added at a time, so a sum costs two instructions instead of eight.
    """

    def generate(context, builder, signature, arguments):
        rest = cgutils.unpack_tuple(builder, arguments[0])
        block = WIDTH // 2
        while block:
            zero = ir.Constant(rest[0].type, None)
            rest = rest + [zero] * (len(rest) % 2)
            starts = range(0, 2 * WIDTH, 2 * block)
            low = [start + i for start in starts for i in range(block)]
            high = [start + block + i for start in starts for i in range(block)]
            rest = [
                builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high))
                for a, b in zip(rest[::2], rest[1::2], strict=True)
            ]
            block //= 2
        return rest[0]

    return vectors.dtype(vectors), generate
