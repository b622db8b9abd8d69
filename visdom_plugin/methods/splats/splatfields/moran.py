"""Moran's I of Gaussians: how much each attribute resembles that of its neighbours (SplatFields)."""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from visdom_plugin.splat.gaussians import Gaussians

NEIGHBOURHOOD = 5
"""Gaussians that are compared with each other: one and its nearest."""
NEIGHBOURHOODS = 1024
"""Of a step, drawn at random; where there are fewer Gaussians, all."""


def moran(features: Tensor, weights: Tensor) -> Tensor:
    """Moran's I of neighbourhoods, without taking off the mean, a scalar; 1 where all of one are alike.

    Args:
        features: (B, n, F), of about the size of 1.
        weights: (B, n, n) of at least 0, of which each neighbourhood has some.
    """
    n = features.shape[1]
    weights = n * weights / weights.sum((1, 2), keepdim=True)
    alike = (features * (weights @ features)).sum(1)
    return (alike / (features.square().sum(1) + 1e-4)).mean()


def moran_loss(gaussians: Gaussians, generator: Generator) -> Tensor:
    """Sum over scales, rotations, opacities and colours of 1 - Moran's I, each between 0 and 1; scalar.

    Neighbours weigh as the inverse of their distance. Places take no gradient.

    Args:
        gaussians: N >= 2, in a unit of about the scene's size.
        generator: on the CPU; draws the neighbourhoods.
    """
    means, count = gaussians.means.detach(), len(gaussians)
    chosen = torch.randperm(count, generator=generator)[:NEIGHBOURHOODS].to(means.device)
    distances = torch.cdist(means[chosen], means, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.topk(min(NEIGHBOURHOOD, count), largest=False).indices
    apart = (means[nearest][:, :, None] - means[nearest][:, None]).norm(dim=-1)
    weights = torch.where(apart > 1e-5, 1 / apart.clamp_min(1e-5), 1e-5)
    attributes = (
        gaussians.log_scales.exp(),
        torch.nn.functional.normalize(gaussians.quaternions, dim=-1),
        gaussians.opacity_logits.sigmoid()[:, None],
        gaussians.sh.flatten(1),
    )
    losses = [1 - moran(x[nearest], weights).clamp(0, 1) for x in attributes]
    return torch.stack(losses).sum()
