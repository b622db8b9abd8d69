"""Multiresolution hash encoding (Instant-NGP) and Zip-NeRF's multisampled, downweighted version of it."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.nerf.hash_layout import HashLayout
from visdom_plugin.nerf.hash_torch import encode_mean_torch, encode_torch

__all__ = ["HashLayout", "encode", "encode_mean", "initial_table", "mean_square_per_level"]


def encode(points: Tensor, table: Tensor, layout: HashLayout, backend: str | None = None) -> Tensor:
    """Features of points, interpolated trilinearly on every level.

    Args:
        points: (..., 3) in [0, 1]^3; what lies outside is clamped to the box. They get no gradient.
        table: (layout.rows, layout.features) float32; gets a gradient.

    Returns:
        (..., layout.width): the features of the coarsest level first.
    """
    return encode_torch(points, table, layout).flatten(-2)


def encode_mean(
    points: Tensor, scales: Tensor, table: Tensor, layout: HashLayout, backend: str | None = None
) -> tuple[Tensor, Tensor]:
    """Features of groups of S points, each downweighted where a level is too fine for it, and averaged.

    A point's features of a level are multiplied by w = erf(1 / (sqrt(8) scale resolution)), as in Zip-NeRF
    (Barron et al. 2023, section 3.1).

    Args:
        points: (..., S, 3) in [0, 1]^3, clamped.
        scales: (..., S) standard deviation of each point's Gaussian in the same units; 0 means w = 1.
        table: (layout.rows, layout.features) float32; the only input that gets a gradient.

    Returns:
        features (..., layout.width), and the mean weights (..., levels) in [0, 1], without gradient.
    """
    features, weights = encode_mean_torch(points, scales, table, layout)
    return features.flatten(-2), weights


def initial_table(layout: HashLayout, generator: torch.Generator, scale: float = 1e-4) -> Tensor:
    """(layout.rows, layout.features) uniform in [-scale, scale], on the generator's device."""
    noise = torch.rand(layout.rows, layout.features, generator=generator, device=generator.device)
    return (2 * noise - 1) * scale


def mean_square_per_level(table: Tensor, layout: HashLayout) -> Tensor:
    """(levels,) mean of the squared features of each level; Zip-NeRF's hash decay is a multiple of their sum."""
    return torch.stack([rows.square().mean() for rows in table.split(layout.sizes)])
