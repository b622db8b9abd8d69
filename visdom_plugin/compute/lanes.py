"""Vectors of 16 numbers for kernels, one row of a tile at a time.

A compiler may find the vectors in a loop or not, and says nothing when it does not. Here a kernel names them: it
loads 16 numbers, calculates with operators as with one, and stores them. Operations keep their order; only a
product and the sum that takes it up may become one instruction.

Calculations mix vectors with plain numbers of the same precision. Comparisons give 16 truth values, which `&`
joins and `where` and `any_of` take.
"""

from __future__ import annotations

import math
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
        super().__init__(manager, lanes, _vector(lanes.element))


def _scalar(element: Any) -> ir.Type:
    if element == types.boolean:
        return ir.IntType(1)
    return ir.FloatType() if element == types.float32 else ir.DoubleType()


def _vector(element: Any) -> ir.VectorType:
    return ir.VectorType(_scalar(element), WIDTH)


def _constant(element: Any, values: list[float]) -> ir.Constant:
    return ir.Constant(_vector(element), [ir.Constant(_scalar(element), v) for v in values])


def _shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(picks)), picks))


def _spread(builder: Any, number: Any) -> Any:
    first = builder.insert_element(
        ir.Constant(ir.VectorType(number.type, WIDTH), ir.Undefined), number, ir.Constant(ir.IntType(32), 0)
    )
    return _shuffle(builder, first, first, [0] * WIDTH)


def _call(builder: Any, name: str, *arguments: Any) -> Any:
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
    """Of lanes mixed with numbers of the same precision; None for anything else."""
    elements = {getattr(a, "element", a) for a in arguments if isinstance(a, LanesType | types.Float)}
    any_lanes = any(isinstance(a, LanesType) for a in arguments)
    if len(arguments) != 2 or not any_lanes or len(elements) != 1:
        return None
    return elements.pop() if all(isinstance(a, LanesType | types.Float) for a in arguments) else None


def _operands(builder: Any, sig: Any, arguments: Any) -> list[Any]:
    return [
        a if isinstance(kind, LanesType) else _spread(builder, a)
        for kind, a in zip(sig.args, arguments, strict=True)
    ]


def _register(function: Any, emit: Callable[[Any, Any, Any], Any], to: Callable[[Any], Any]) -> None:
    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            element = _element_of(arguments)
            result = None if element is None else to(element)
            return None if result is None else signature(LanesType(result), *arguments)

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return emit(builder, *_operands(builder, sig, arguments))

    for kinds in ((LanesType, LanesType), (LanesType, types.Float), (types.Float, LanesType)):
        lower_builtin(function, *kinds)(lower)


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
        steps = _constant(number, [float(i) for i in range(WIDTH)])
        return builder.fadd(_spread(builder, arguments[0]), steps)

    return LanesType(number)(number), generate


def _place(context: Any, builder: Any, array: Any, value: Any, index: Any) -> Any:
    data = context.make_array(array)(context, builder, value).data
    first = builder.gep(data, [index])
    return builder.bitcast(first, _vector(array.dtype).as_pointer())


@intrinsic
def load(typing_context, array, index):
    """Numbers index .. index + 15 of a contiguous array, counted through all its dimensions. Not bound checked."""

    def generate(context, builder, signature, arguments):
        out = builder.load(_place(context, builder, array, *arguments))
        out.align = context.get_abi_sizeof(_scalar(array.dtype))
        return out

    return LanesType(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing_context, array, index, lanes):
    """Writes numbers index .. index + 15 of a contiguous array. Not bound checked."""

    def generate(context, builder, signature, arguments):
        place = _place(context, builder, array, *arguments[:2])
        builder.store(arguments[2], place, align=context.get_abi_sizeof(_scalar(array.dtype)))
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@intrinsic
def where(typing_context, condition, yes, no):
    """`yes` where a condition holds, else `no`; either may be a number."""
    element = getattr(yes, "element", yes)
    if element != getattr(no, "element", no):
        return None

    def generate(context, builder, signature, arguments):
        chosen = [
            a if isinstance(kind, LanesType) else _spread(builder, a)
            for kind, a in zip((yes, no), arguments[1:], strict=True)
        ]
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
    def intrinsic_for(typing_context, lanes, number):
        def generate(context, builder, signature, arguments):
            bound = _spread(builder, arguments[1])
            inside = builder.fcmp_ordered(sign, arguments[0], bound)
            return builder.select(inside, arguments[0], bound)

        return lanes(lanes, number), generate

    return intrinsic_for


minimum = intrinsic(_bounded("<"))
"""The smaller of each lane and a number; NaN gives the number."""
maximum = intrinsic(_bounded(">"))
"""The larger of each lane and a number; NaN gives the number."""


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
            return _constant(element, [value] * WIDTH)

        def multiply_add(x, y, z):
            return builder.fadd(builder.fmul(x, y, flags=("contract",)), z, flags=("contract",))

        whole = _call(builder, "rint", arguments[0])
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
