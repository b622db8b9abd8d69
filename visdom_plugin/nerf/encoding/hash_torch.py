"""The hash encoding in plain torch operations: any device, any dtype, the reference of the fast versions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visdom_plugin.nerf.encoding.hash_layout import PRIMES, HashLayout

BITS = 0xFFFFFFFF


def encode_torch(points: Tensor, scales: Tensor | None, table: Tensor, layout: HashLayout):
    """(groups, S, 3), (groups, S) or None -> (groups, levels * features), (groups, levels) or None."""
    points = torch.where(points > 0, points, 0.0).clamp(max=1)  # NaN counts as 0
    levels = torch.stack([_level(points, table, layout, level) for level in range(layout.levels)], -2)
    if scales is None:
        return levels.mean(1).flatten(1), None
    resolutions = torch.tensor(layout.resolutions, dtype=points.dtype, device=points.device)
    weights = torch.erf(1 / (math.sqrt(8) * scales[..., None] * resolutions))
    return (weights[..., None] * levels).mean(1).flatten(1), weights.mean(1)


def _level(points: Tensor, table: Tensor, layout: HashLayout, level: int) -> Tensor:
    """(..., features) of one level."""
    resolution, offset = layout.resolutions[level], layout.offsets[level]
    position = points * resolution
    cell = position.floor().clamp(max=resolution - 1)
    fraction = position - cell
    cell = cell.long()
    total = table.new_zeros(())
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        x, y, z = (cell[..., axis] + bits[axis] for axis in range(3))
        if layout.dense[level]:
            row = x + (resolution + 1) * (y + (resolution + 1) * z)
        else:
            row = ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & BITS & (layout.sizes[level] - 1)
        weight = fraction.new_ones(())
        for axis in range(3):
            weight = weight * (fraction[..., axis] if bits[axis] else 1 - fraction[..., axis])
        # index_select, since its gradient is faster than that of indexing or of an embedding.
        features = table.index_select(0, (offset + row).flatten()).view(*row.shape, layout.features)
        total = total + weight[..., None] * features
    return total
