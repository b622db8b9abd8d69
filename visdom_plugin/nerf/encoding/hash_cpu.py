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


def encode_cpu(
    points: Tensor,
    scales: Tensor | None,
    table: Tensor,
    layout: HashLayout,
    spans: Tensor | None = None,
    squares: Tensor | None = None,
):
    """(groups, S, 3), (groups, S) or None -> (groups, levels * features), (groups, levels) or an empty tensor.

    With spans (levels,) the second is times them, as the kernel says. With the mean squares (levels,) of the table
    they come out third, with a gradient.
    """
    out = _Encode.apply(table, points, scales, layout, spans, squares)
    return out if squares is not None else out[:2]


@cache
def describe(layout: HashLayout) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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
    def forward(ctx, table, points, scales, layout, spans, squares):
        ctx.set_materialize_grads(False)
        groups, samples = points.shape[:-1]
        ctx.layout, ctx.samples = layout, samples
        ctx.save_for_backward(points, scales, None if squares is None else table)
        out = torch.empty(groups, layout.width)
        mean_strengths = torch.empty(groups if scales is not None else 0, layout.levels)
        if samples > hash_kernels.BLOCK:
            raise ValueError(f"groups of {samples} points; the CPU kernels take {hash_kernels.BLOCK} at most")
        blocks = -(-groups // (hash_kernels.BLOCK // samples))
        parallel_for(
            hash_kernels.encode, layout.levels * blocks, max(blocks // PIECES_PER_LEVEL, 1), samples,
            _flat(points), _flat(scales), _flat(table), layout.features, *describe(layout),
            _flat(spans), _flat(out), _flat(mean_strengths),
        )  # fmt: skip
        ctx.mark_non_differentiable(mean_strengths)
        return out, mean_strengths, None if squares is None else squares.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out, _, g_squares):
        points, scales, table = ctx.saved_tensors
        layout, samples = ctx.layout, ctx.samples
        g_table = torch.empty(layout.rows, layout.features)
        if g_out is None:
            g_out = torch.zeros(len(points), layout.width)
        decay = None if g_squares is None else g_squares * share_of_each(layout)
        parallel_for(
            hash_kernels.encode_backward, layout.levels, 1, samples, _flat(points), _flat(scales),
            _flat(g_out), layout.features, *describe(layout), _flat(table), _flat(decay), _flat(g_table),
        )  # fmt: skip
        return g_table, None, None, None, None, None


@cache
def share_of_each(layout: HashLayout) -> Tensor:
    """(levels,) slope of a mean square by a feature of the level, over the feature."""
    return 2 / (torch.tensor(layout.sizes, dtype=torch.float32) * layout.features)


def mean_squares(table: Tensor, layout: HashLayout) -> Tensor:
    """(levels,) means of the squared features of each level of a table, without gradient."""
    out = torch.empty(layout.levels)
    offsets = describe(layout)[-1]
    parallel_for(
        hash_kernels.mean_squares, layout.levels, 1, _flat(table), layout.features, offsets, _flat(out)
    )
    return out
