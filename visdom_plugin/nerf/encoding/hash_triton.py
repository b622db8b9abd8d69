"""The hash encoding on CUDA as Triton kernels. Imported only where it is used; Triton comes with torch for CUDA.

A program takes one level of a block of groups. The gradient is added up by atomic operations, in no fixed order.
Tested against the plain torch version, on a GPU or in Triton's interpreter.
"""

from __future__ import annotations

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.nerf.encoding.hash_layout import HashLayout

GROUPS = 128
"""Groups of points per program."""


def encode_triton(points: Tensor, scales: Tensor | None, table: Tensor, layout: HashLayout):
    """(groups, S, 3), (groups, S) or None -> (groups, levels * features), (groups, levels) or an empty tensor."""
    return _Encode.apply(table, points, scales, layout)


@cache
def _describe(layout: HashLayout, device: torch.device) -> Tensor:
    """(levels, 4) int32: resolution, first row, mask of the hash, whether dense."""
    sizes = zip(layout.sizes, layout.dense, strict=True)
    masks = [0 if dense else size - 1 for size, dense in sizes]
    columns = (layout.resolutions, layout.offsets[:-1], masks, layout.dense)
    return torch.tensor([[int(x) for x in row] for row in zip(*columns, strict=True)], dtype=torch.int32).to(
        device
    )


@triton.jit
def _axis(points, at, resolution, live):
    """Cell and fraction along one axis; NaN counts as 0."""
    x = tl.load(points + at, live, 0.0)
    x = tl.minimum(tl.where(x > 0, x, 0.0), 1.0) * resolution
    cell = tl.minimum(x.to(tl.int32), resolution - 1)
    return cell.to(tl.uint32), x - cell


@triton.jit
def _strength(scales, at, resolution, live):
    # 0.35355339 = 1 / sqrt 8. A scale of 0 gives infinity, and erf 1.
    return tl.erf(0.35355339 / (tl.load(scales + at, live, 1.0) * resolution))


@triton.jit
def _corner(i, j, k, u, v, w, resolution, offset, mask, dense, CORNER: tl.constexpr):
    """Row and weight of one corner."""
    X: tl.constexpr = CORNER & 1
    Y: tl.constexpr = (CORNER >> 1) & 1
    Z: tl.constexpr = CORNER >> 2
    i, j, k = i + X, j + Y, k + Z
    side = (resolution + 1).to(tl.uint32)
    straight = i + side * (j + side * k)
    hashed = (i ^ (j * 2654435761) ^ (k * 805459861)) & mask.to(tl.uint32)
    row = tl.where(dense != 0, straight, hashed).to(tl.int64) + offset
    weight = (u if X else 1 - u) * (v if Y else 1 - v) * (w if Z else 1 - w)
    return row, weight


@triton.jit
def _forward(
    points, scales, table, levels, out, mean_strengths, groups,
    SAMPLES: tl.constexpr, LEVELS: tl.constexpr, FEATURES: tl.constexpr, WIDE: tl.constexpr,
    SCALED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    level = tl.program_id(1)
    group = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    feature = tl.arange(0, WIDE)
    live = group < groups
    both = live[:, None] & (feature < FEATURES)[None, :]
    resolution, offset = tl.load(levels + level * 4), tl.load(levels + level * 4 + 1)
    mask, dense = tl.load(levels + level * 4 + 2), tl.load(levels + level * 4 + 3)
    total = tl.zeros((BLOCK, WIDE), tl.float32)
    strengths = tl.zeros((BLOCK,), tl.float32)
    for sample in range(SAMPLES):
        at = group * SAMPLES + sample
        i, u = _axis(points, at * 3, resolution, live)
        j, v = _axis(points, at * 3 + 1, resolution, live)
        k, w = _axis(points, at * 3 + 2, resolution, live)
        features = tl.zeros((BLOCK, WIDE), tl.float32)
        for corner in tl.static_range(8):
            row, weight = _corner(i, j, k, u, v, w, resolution, offset, mask, dense, corner)
            values = tl.load(table + row[:, None] * FEATURES + feature[None, :], both, 0.0)
            features += weight[:, None] * values
        if SCALED:
            strength = _strength(scales, at, resolution, live)
            features *= strength[:, None]
            strengths += strength
        total += features
    to = (group * LEVELS + level)[:, None] * FEATURES + feature[None, :]
    tl.store(out + to, total / SAMPLES, both)
    if SCALED:
        tl.store(mean_strengths + group * LEVELS + level, strengths / SAMPLES, live)


@triton.jit
def _backward(
    points, scales, g_out, levels, g_table, groups,
    SAMPLES: tl.constexpr, LEVELS: tl.constexpr, FEATURES: tl.constexpr, WIDE: tl.constexpr,
    SCALED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    level = tl.program_id(1)
    group = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    feature = tl.arange(0, WIDE)
    live = group < groups
    both = live[:, None] & (feature < FEATURES)[None, :]
    resolution, offset = tl.load(levels + level * 4), tl.load(levels + level * 4 + 1)
    mask, dense = tl.load(levels + level * 4 + 2), tl.load(levels + level * 4 + 3)
    source = (group * LEVELS + level)[:, None] * FEATURES + feature[None, :]
    gradient = tl.load(g_out + source, both, 0.0) / SAMPLES
    for sample in range(SAMPLES):
        at = group * SAMPLES + sample
        i, u = _axis(points, at * 3, resolution, live)
        j, v = _axis(points, at * 3 + 1, resolution, live)
        k, w = _axis(points, at * 3 + 2, resolution, live)
        part = gradient
        if SCALED:
            part = gradient * _strength(scales, at, resolution, live)[:, None]
        for corner in tl.static_range(8):
            row, weight = _corner(i, j, k, u, v, w, resolution, offset, mask, dense, corner)
            place = g_table + row[:, None] * FEATURES + feature[None, :]
            tl.atomic_add(place, weight[:, None] * part, both, sem="relaxed")


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, points, scales, layout):
        ctx.layout = layout
        ctx.save_for_backward(points, scales)
        groups = len(points)
        out = table.new_empty(groups, layout.width)
        strengths = table.new_empty(groups if scales is not None else 0, layout.levels)
        _launch(_forward, points, scales, layout, table.detach().contiguous(), out, strengths)
        ctx.mark_non_differentiable(strengths)
        return out, strengths

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out, _):
        points, scales = ctx.saved_tensors
        g_table = g_out.new_zeros(ctx.layout.rows, ctx.layout.features)
        _launch(_backward, points, scales, ctx.layout, g_out.contiguous(), g_table)
        return g_table, None, None, None


def _launch(
    kernel, points: Tensor, scales: Tensor | None, layout: HashLayout, source: Tensor, *results: Tensor
):
    groups, samples = points.shape[:2]
    if groups == 0:
        return
    kernel[(triton.cdiv(groups, GROUPS), layout.levels)](
        points.contiguous(), points if scales is None else scales.contiguous(), source,
        _describe(layout, points.device), *results, groups, samples, layout.levels, layout.features,
        triton.next_power_of_2(layout.features), scales is not None, GROUPS,
    )  # fmt: skip
