"""Volume rendering of dense samples: every ray has S intervals (Max 1995, Mildenhall et al. 2020).

Distances are along unit directions, in the unit in which density is per length. On the CPU kernels go along each
ray, forward and back, with sums in float64; elsewhere, and for distances that have a gradient, the same in torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

MAX_DENSITY = 1e30  # so that an infinite density in an interval of no length is 0, not NaN
EMPTY = 1e-6  # alpha below which the depth leans towards the far end
RAYS_PER_PIECE = 64


def weights_from_density(density: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
    """Probability that a ray ends in each interval (mip-NeRF, eq. 1 and 2).

    Args:
        density: (..., S) per length, >= 0; infinity is allowed. Differentiable.
        distances: (..., S + 1) ascending edges of the intervals.

    Returns:
        weights (..., S), which sum to 1 minus the transmittance behind the last interval, and transmittance
        (..., S) in front of each interval.
    """
    if _has_kernels(density, distances):
        return _Weights.apply(density, distances.expand(*density.shape[:-1], -1).to(density))
    return _weights_torch(density, distances)


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
    if _has_kernels(weights, distances) and rgb.dtype == weights.dtype:
        lead = weights.shape[:-1]
        distances, background = (x.expand(*lead, x.shape[-1]).to(weights) for x in (distances, background))
        return _Composite.apply(weights, rgb.expand(*weights.shape, 3), distances, background)
    return _composite_torch(weights, rgb, distances, background)


def _has_kernels(values: Tensor, distances: Tensor) -> bool:
    constant = not (torch.is_grad_enabled() and distances.requires_grad)
    plain = values.device.type == "cpu" and values.dtype in (torch.float32, torch.float64)
    return constant and plain and values.shape[-1] > 0


def _weights_torch(density: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
    depth = density.clamp_max(MAX_DENSITY) * distances.diff(dim=-1)
    passed = torch.exp(-depth.cumsum(-1))
    transmittance = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], -1)
    return transmittance * -torch.expm1(-depth), transmittance


def _composite_torch(
    weights: Tensor, rgb: Tensor, distances: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    alpha = weights.sum(-1)
    colour = (weights[..., None, :] @ rgb)[..., 0, :] + (1 - alpha)[..., None] * background
    middles = 0.5 * (distances[..., 1:] + distances[..., :-1])
    depth = ((weights * middles).sum(-1) + EMPTY * distances[..., -1]) / (alpha + EMPTY)
    return colour, alpha, depth


def _rows(x: Tensor, *shape: int) -> np.ndarray:
    """Contiguous, one row per ray."""
    return x.detach().contiguous().numpy().reshape(-1, *shape)


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, density: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        samples = density.shape[-1]
        ctx.arrays = given = _rows(density, samples), _rows(distances, samples + 1)
        weights, passed = density.new_empty(density.shape), distances.new_empty(distances.shape)
        parallel_for(
            _weigh,
            len(given[0]),
            RAYS_PER_PIECE,
            *given,
            *(_rows(weights, samples), _rows(passed, samples + 1)),
        )
        ctx.save_for_backward(weights, passed)
        return weights, passed[..., :-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_weights: Tensor | None, by_transmittance: Tensor | None) -> tuple[Tensor, None]:
        weights, passed = ctx.saved_tensors
        samples = weights.shape[-1]
        slopes = [
            _rows(x, samples) if x is not None else np.empty((0, samples), ctx.arrays[0].dtype)
            for x in (by_weights, by_transmittance)
        ]
        by_density = torch.empty_like(weights, memory_format=torch.contiguous_format)
        arrays = *ctx.arrays, _rows(weights, samples), _rows(passed, samples + 1), *slopes
        parallel_for(_weigh_back, len(arrays[0]), RAYS_PER_PIECE, *arrays, _rows(by_density, samples))
        return by_density, None


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, rgb: Tensor, distances: Tensor, background: Tensor):
        lead, samples = weights.shape[:-1], weights.shape[-1]
        given = (
            _rows(weights, samples),
            _rows(rgb, samples, 3),
            _rows(distances, samples + 1),
            _rows(background, 3),
        )
        colour, alpha, depth = (weights.new_empty(*lead, *tail) for tail in ((3,), (), ()))
        out = _rows(colour, 3), _rows(alpha), _rows(depth)
        parallel_for(_compose, len(given[0]), RAYS_PER_PIECE, *given, *out)
        ctx.arrays, ctx.shape = (*given, *out[1:]), rgb.shape
        return colour, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor):
        by_weights, by_rgb, by_background = (
            np.empty_like(x) for x in (ctx.arrays[0], ctx.arrays[1], ctx.arrays[3])
        )
        given = [_rows(g, *tail) for g, tail in zip(slopes, ((3,), (), ()), strict=True)]
        out = by_weights, by_rgb, by_background
        parallel_for(_compose_back, len(by_weights), RAYS_PER_PIECE, *ctx.arrays, *given, *out)
        by_weights, by_rgb, by_background = (torch.from_numpy(x) for x in out)
        lead = ctx.shape[:-2]
        return by_weights.view(ctx.shape[:-1]), by_rgb.view(ctx.shape), None, by_background.view(*lead, 3)


@kernel(error_model="numpy")
def _weigh(begin, end, density, distances, weights, passed):
    for ray in range(begin, end):
        transmittance = 1.0
        passed[ray, 0] = transmittance
        for i in range(weights.shape[1]):
            thick = np.float64(MAX_DENSITY if density[ray, i] > MAX_DENSITY else density[ray, i])
            through = np.exp(-thick * (np.float64(distances[ray, i + 1]) - distances[ray, i]))
            weights[ray, i] = transmittance * (1.0 - through)
            transmittance *= through
            passed[ray, i + 1] = transmittance


@kernel(error_model="numpy")
def _weigh_back(
    begin, end, density, distances, weights, passed, by_weights, by_transmittance, by_density
):  # fmt: skip
    """With q the slope by a weight and p that by the transmittance in front, the slope by the optical depth of
    interval i is passed_{i+1} q_i - sum_{j > i} (weight_j q_j + passed_j p_j)."""
    for ray in range(begin, end):
        hidden = 0.0
        for i in range(weights.shape[1] - 1, -1, -1):
            slope = np.float64(by_weights[ray, i]) if len(by_weights) else 0.0
            length = np.float64(distances[ray, i + 1]) - distances[ray, i]
            by_density[ray, i] = length * (passed[ray, i + 1] * slope - hidden)
            if density[ray, i] > MAX_DENSITY:
                by_density[ray, i] = 0
            hidden += weights[ray, i] * slope
            if len(by_transmittance):
                hidden += passed[ray, i] * np.float64(by_transmittance[ray, i])


@kernel(error_model="numpy")
def _compose(begin, end, weights, rgb, distances, background, colour, alpha, depth):
    last = weights.shape[1]
    for ray in range(begin, end):
        red, green, blue, total, distance = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(last):
            weight = np.float64(weights[ray, i])
            total += weight
            red += weight * rgb[ray, i, 0]
            green += weight * rgb[ray, i, 1]
            blue += weight * rgb[ray, i, 2]
            distance += weight * 0.5 * (np.float64(distances[ray, i]) + distances[ray, i + 1])
        colour[ray, 0] = red + (1.0 - total) * background[ray, 0]
        colour[ray, 1] = green + (1.0 - total) * background[ray, 1]
        colour[ray, 2] = blue + (1.0 - total) * background[ray, 2]
        alpha[ray] = total
        depth[ray] = (distance + EMPTY * distances[ray, last]) / (total + EMPTY)


@kernel(error_model="numpy")
def _compose_back(
    begin, end, weights, rgb, distances, background, alpha, depth, by_colour, by_alpha, by_depth,
    by_weights, by_rgb, by_background,
):  # fmt: skip
    for ray in range(begin, end):
        red, green, blue = np.float64(by_colour[ray, 0]), by_colour[ray, 1], by_colour[ray, 2]
        by_distance = by_depth[ray] / (np.float64(alpha[ray]) + EMPTY)
        base = by_alpha[ray] - (
            red * background[ray, 0] + green * background[ray, 1] + blue * background[ray, 2]
        )
        for i in range(weights.shape[1]):
            middle = 0.5 * (np.float64(distances[ray, i]) + distances[ray, i + 1])
            slope = base + red * rgb[ray, i, 0] + green * rgb[ray, i, 1] + blue * rgb[ray, i, 2]
            by_weights[ray, i] = slope + by_distance * (middle - depth[ray])
            by_rgb[ray, i, 0] = weights[ray, i] * red
            by_rgb[ray, i, 1] = weights[ray, i] * green
            by_rgb[ray, i, 2] = weights[ray, i] * blue
        for c in range(3):
            by_background[ray, c] = (1.0 - alpha[ray]) * by_colour[ray, c]
