"""Adam for the parameters of a radiance field on the CPU: all of them in one launch.

Numbers are rounded as in torch's fused Adam, but for the last few of a tensor.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for_each

BLOCK = 1024
"""Numbers of a block."""
BLOCKS_PER_PIECE = 16


class Update(NamedTuple):
    """What one step changes of a parameter: flat arrays of float32, as long as one another."""

    parameter: np.ndarray
    gradient: np.ndarray
    mean: np.ndarray
    """Moving mean of the gradient, Adam's first moment."""
    square: np.ndarray
    """Moving mean of its square, the second moment."""
    rate: float
    """The learning rate, divided by the first moment's bias."""
    root: float
    """Root of the second moment's bias."""
    decay: float
    """Times the parameter, added to the gradient."""
    kept: float
    """What is left of the parameter before the step; 1 for all of it."""


@intrinsic
def _fma(typing_context, a, b, c):
    """a b + c of three float32 numbers, rounded once."""

    def generate(context, builder, signature, arguments):
        kind = arguments[0].type
        function = cgutils.get_or_insert_function(
            builder.module, cgutils.ir.FunctionType(kind, [kind] * 3), "llvm.fma.f32"
        )
        return builder.call(function, arguments)

    return types.float32(types.float32, types.float32, types.float32), generate


@kernel(error_model="numpy", counted=False)
def _update(
    begin, end, parameter, gradient, mean, square, rate, root, decay, kept, fresh, old, fresh_square, epsilon
):
    """Blocks begin .. end - 1; the last one may be shorter."""
    for block in range(begin, end):
        first = block * BLOCK
        last = min(first + BLOCK, len(parameter))
        # Slices, because their indices are seen not to be negative, and the loop becomes vectors.
        p, g, m, v = parameter[first:last], gradient[first:last], mean[first:last], square[first:last]
        for i in range(len(p)):
            value = p[i]
            slope = _fma(value, decay, g[i])
            m[i] = _fma(fresh, slope - m[i], m[i])
            v[i] = _fma(fresh_square * slope, slope, old * v[i])
            p[i] = value * kept - rate * m[i] / (np.sqrt(v[i]) / root + epsilon)


def update_all(updates: Iterable[Update], betas: tuple[float, float], epsilon: float) -> None:
    """One step of Adam, in place; the same to the bit for any number of threads."""
    real = np.float32
    settings = [real(x) for x in (1 - betas[0], betas[1], 1 - betas[1], epsilon)]
    runs = [(-(-len(u.parameter) // BLOCK), (*u[:4], *map(real, u[4:]), *settings)) for u in updates]
    parallel_for_each(_update, BLOCKS_PER_PIECE, runs)
