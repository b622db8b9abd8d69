"""Volume rendering of dense samples: every ray has S intervals (Max 1995, Mildenhall et al. 2020).

Distances are along unit directions, in the unit in which density is per length.
"""

from __future__ import annotations

import torch
from torch import Tensor

MAX_DENSITY = 1e30  # so that an infinite density in an interval of no length is 0, not NaN
EMPTY = 1e-6  # alpha below which the depth leans towards the far end


def weights_from_density(density: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
    """Probability that a ray ends in each interval (mip-NeRF, eq. 1 and 2).

    Args:
        density: (..., S) per length, >= 0; infinity is allowed. Differentiable.
        distances: (..., S + 1) ascending edges of the intervals.

    Returns:
        weights (..., S), which sum to 1 minus the transmittance behind the last interval, and transmittance
        (..., S) in front of each interval.
    """
    depth = density.clamp_max(MAX_DENSITY) * distances.diff(dim=-1)
    passed = torch.exp(-depth.cumsum(-1))
    transmittance = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], -1)
    return transmittance * -torch.expm1(-depth), transmittance


def composite(
    weights: Tensor, rgb: Tensor, distances: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, alpha and depth of rays.

    Args:
        weights: (..., S) of `weights_from_density`.
        rgb: (..., S, 3).
        distances: (..., S + 1) edges of the intervals.
        background: (..., 3) or (3,) colour behind the last interval.

    Returns:
        rgb (..., 3) over the background; alpha (...) in [0, 1]; depth (...), the mean of the intervals' middles
        by weight, that is, where the ray ends if it does. As alpha falls below 1e-6 the depth goes to the last
        edge, which it is for alpha 0.
    """
    alpha = weights.sum(-1)
    colour = (weights[..., None, :] @ rgb)[..., 0, :] + (1 - alpha)[..., None] * background
    middles = 0.5 * (distances[..., 1:] + distances[..., :-1])
    depth = ((weights * middles).sum(-1) + EMPTY * distances[..., -1]) / (alpha + EMPTY)
    return colour, alpha, depth
