"""Adam for parameters of Gaussians on the CPU: all of them in one launch."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for_each

NUMBERS = 768
"""Of a block, at most."""
BLOCKS_PER_PIECE = 16


class Update(NamedTuple):
    """What one step changes of a parameter: flat arrays of float32, as long as one another."""

    parameter: np.ndarray
    gradient: np.ndarray
    mean: np.ndarray
    """Moving mean of the gradient, Adam's first moment."""
    square: np.ndarray
    """Moving mean of its square, the second moment."""
    shares: np.ndarray
    """Of the learning rate, at which the numbers of a block learn; see `repeat`."""
    rate: float
    """The learning rate, divided by the first moment's bias."""
    root: float
    """Root of the second moment's bias."""


@cache
def repeat(first: int, row: int, share: float) -> np.ndarray:
    """Shares for a block of rows of so many numbers: 1 for the first ones of a row, `share` for the others."""
    return np.tile(np.where(np.arange(row) < first, 1, share).astype(np.float32), max(NUMBERS // row, 1))


@kernel(error_model="numpy", counted=False)
def _update(
    begin, end, parameter, gradient, mean, square, shares, rate, root, fresh, kept, fresh_square, epsilon
):
    """Blocks begin .. end - 1 of len(shares) numbers; the last one may be shorter."""
    for block in range(begin, end):
        first = block * len(shares)
        last = min(first + len(shares), len(parameter))
        # Slices, because their indices are seen not to be negative, and the loop becomes vectors.
        p, g, m, v = parameter[first:last], gradient[first:last], mean[first:last], square[first:last]
        for i in range(len(p)):
            slope = g[i]
            m[i] += fresh * (slope - m[i])
            v[i] = kept * v[i] + fresh_square * slope * slope
            p[i] -= rate * shares[i] * m[i] / (np.sqrt(v[i]) / root + epsilon)


def update(updates: Iterable[Update], betas: tuple[float, float], epsilon: float) -> None:
    """One step of Adam, in place; the same to the bit for any number of threads."""
    settings = [np.float32(x) for x in (1 - betas[0], betas[1], 1 - betas[1], epsilon)]
    runs = [
        (-(-len(u.parameter) // len(u.shares)), (*u[:5], np.float32(u.rate), np.float32(u.root), *settings))
        for u in updates
    ]
    parallel_for_each(_update, BLOCKS_PER_PIECE, runs)
