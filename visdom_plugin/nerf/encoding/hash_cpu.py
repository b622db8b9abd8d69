"""The hash encoding on the CPU: numba kernels as a differentiable function of the table.

Results repeat to the bit, whatever the number of threads: forward, an item is a level of a block of points;
backward, an item is a whole level, whose rows are added to in the order of the points.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.nerf.encoding import hash_kernels
from visdom_plugin.nerf.encoding.hash_layout import HashLayout

PIECES_PER_LEVEL = 4
"""Launching a piece costs some 10 us; below this many, two threads wait for one another at the end."""
LARGE = 1 << 20
"""Numbers in a table from which it is worth while to square them on several threads."""
SUMMED = 1024
"""Squares summed in float32 at a time."""


def encode_cpu(points: Tensor, scales: Tensor | None, table: Tensor, layout: HashLayout):
    """(groups, S, 3), (groups, S) or None -> (groups, levels * features), (groups, levels) or an empty tensor."""
    return _Encode.apply(table, points, scales, layout)


@cache
def _describe(layout: HashLayout) -> tuple[np.ndarray, ...]:
    """Resolutions, whether dense, masks of the hash, first rows (and their number): what the kernels read."""
    masks = [0 if dense else size - 1 for dense, size in zip(layout.dense, layout.sizes, strict=True)]
    return (
        np.array(layout.resolutions, np.int64),
        np.array(layout.dense),
        np.array(masks, np.int64),
        np.array(layout.offsets, np.int64),
    )


def _flat(tensor: Tensor | None) -> np.ndarray:
    if tensor is None:
        return np.empty(0, np.float32)
    return tensor.detach().contiguous().numpy().reshape(-1)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, points, scales, layout):
        groups, samples = points.shape[:-1]
        ctx.layout, ctx.samples = layout, samples
        ctx.save_for_backward(points, scales)
        out = torch.empty(groups, layout.width)
        mean_strengths = torch.empty(groups if scales is not None else 0, layout.levels)
        if samples > hash_kernels.BLOCK:
            raise ValueError(f"groups of {samples} points; the CPU kernels take {hash_kernels.BLOCK} at most")
        blocks = -(-groups // (hash_kernels.BLOCK // samples))
        parallel_for(
            hash_kernels.encode, layout.levels * blocks, max(blocks // PIECES_PER_LEVEL, 1), samples,
            _flat(points), _flat(scales), _flat(table), layout.features, *_describe(layout),
            _flat(out), _flat(mean_strengths),
        )  # fmt: skip
        ctx.mark_non_differentiable(mean_strengths)
        return out, mean_strengths

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out, _):
        points, scales = ctx.saved_tensors
        layout, samples = ctx.layout, ctx.samples
        g_table = torch.empty(layout.rows, layout.features)
        parallel_for(
            hash_kernels.encode_backward, layout.levels, 1, samples, _flat(points), _flat(scales),
            _flat(g_out), layout.features, *_describe(layout), _flat(g_table),
        )  # fmt: skip
        return g_table, None, None, None


class MeanSquares(torch.autograd.Function):
    """(levels,) means of the squared features of each level of a table, and their gradient, level by level."""

    @staticmethod
    def forward(ctx, table, sizes):
        ctx.save_for_backward(table)
        ctx.sizes = sizes
        levels, out = [rows.detach().numpy() for rows in table.split(sizes)], torch.empty(len(sizes))

        def find(begin: int, end: int) -> None:
            for level in range(begin, end):
                out[level] = _mean_square(levels[level].reshape(-1))

        parallel_for(find, len(sizes), _grain(table, sizes))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        (table,) = ctx.saved_tensors
        out = torch.empty_like(table)
        pairs = list(zip(*(x.detach().split(ctx.sizes) for x in (table, out)), g.tolist(), strict=True))

        def scale(begin: int, end: int) -> None:
            for rows, to, factor in pairs[begin:end]:
                np.multiply(rows.numpy(), np.float32(2 * factor / rows.numel()), out=to.numpy())

        parallel_for(scale, len(pairs), _grain(table, ctx.sizes))
        return out, None


def _grain(table: Tensor, sizes: tuple[int, ...]) -> int:
    """Levels in a piece: all of a small table, which a second thread would not have done sooner."""
    return 1 if table.numel() > LARGE else len(sizes)


def _mean_square(values: np.ndarray) -> float:
    """Of (n,), exact enough in float32: sums of blocks are summed in float64."""
    whole = len(values) // SUMMED * SUMMED
    blocks = values[:whole].reshape(-1, SUMMED)
    total = np.einsum("ij,ij->i", blocks, blocks).sum(dtype=np.float64)
    rest = values[whole:]
    return float((total + np.einsum("i,i->", rest, rest)) / len(values))
