"""Step functions on a ray: S intervals between sorted edges t (..., S + 1), each with a weight (..., S), which is
the mass in the interval (mass per length is called density). Nothing here carries a gradient.

The maths of mip-NeRF 360 (resampling, annealing) and Zip-NeRF (blurring).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.nerf.sampling import ray_warp, step_kernels
from visdom_plugin.nerf.sampling.step_kernels import LEAST_WEIGHT


@torch.no_grad()
def sample_edges(edges: Tensor, weights: Tensor, count: int, jitter: Tensor | None = None) -> Tensor:
    """Edges of `count` new intervals, dense where the weights are.

    As in mip-NeRF 360: `count` points that split the mass evenly become the intervals' middles, so to say; the
    new edges lie half way between neighbouring points, and the two outermost mirror their neighbours, inside
    the old edges.

    Args:
        edges: (..., S + 1) ascending.
        weights: (..., S) >= 0, of any sum.
        count: at least 2.
        jitter: (..., count) or (..., 1) in [0, 1), uniform: one number per point, or one that moves all points of
            a ray together. None: 0.5.

    Returns:
        (..., count + 1) ascending, within the old edges.
    """
    if edges.device.type == "cpu":
        return _sample_cpu(edges, weights, count, jitter)[0]
    return _sample_torch(edges, weights, count, jitter)


@torch.no_grad()
def sample_distances(
    edges: Tensor,
    weights: Tensor,
    count: int,
    near: Tensor,
    far: Tensor,
    *,
    exponent: float = 1.0,
    power: float = ray_warp.POWER,
    jitter: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """`sample_edges` of normalised distances by weights^exponent, and where the new edges lie along the ray.

    Args:
        near, far: (...) bounds of the ray.
        power: of the ladder between them, see `ray_warp.distances_of`.

    Returns:
        New edges (..., count + 1) in [0, 1], and their distances (..., count + 1) in [near, far].
    """
    near, far = near[..., None], far[..., None]
    if edges.device.type == "cpu":
        edges, distances = _sample_cpu(edges, weights, count, jitter, (near, far), exponent, power)
        return edges, distances
    lead = torch.broadcast_shapes(edges.shape[:-1], near.shape[:-1])
    edges = _sample_torch(edges.expand(*lead, edges.shape[-1]), weights**exponent, count, jitter)
    return edges, ray_warp.distances_of(edges, near, far, power)


def _sample_cpu(
    edges: Tensor,
    weights: Tensor,
    count: int,
    jitter: Tensor | None,
    bounds: tuple[Tensor, Tensor] | None = None,
    exponent: float = 1.0,
    power: float = 1.0,
) -> list[Tensor]:
    """New edges and, in the second place, their distances between the bounds (..., 1); nothing there without."""
    jitter = _jitter_of(edges, count, jitter)
    near, far = bounds or (jitter[..., :1], jitter[..., :1])
    columns = count + 1, count + 1 if bounds else 0
    real = np.float32 if edges.dtype == torch.float32 else np.float64
    scalars = real(exponent), power, real(1 / power), ray_warp.factor_of(power)
    return step_kernels.run(step_kernels.sample, columns, (edges, weights, jitter, near, far), *scalars)


def _jitter_of(edges: Tensor, count: int, jitter: Tensor | None) -> Tensor:
    if count < 2:
        raise ValueError(f"sample_edges makes at least 2 intervals, not {count}")
    return edges.new_full((1,), 0.5) if jitter is None else jitter


def _sample_torch(edges: Tensor, weights: Tensor, count: int, jitter: Tensor | None) -> Tensor:
    jitter = _jitter_of(edges, count, jitter)
    lead = torch.broadcast_shapes(*(x.shape[:-1] for x in (edges, weights, jitter)))
    edges, weights = (x.expand(*lead, x.shape[-1]) for x in (edges, weights))
    mass = weights.clamp_min(LEAST_WEIGHT).cumsum(-1)
    mass = torch.nn.functional.pad(mass / mass[..., -1:], (1, 0))
    steps = torch.arange(count, dtype=mass.dtype, device=mass.device)
    u = ((steps + jitter) / count).expand(*lead, count).contiguous()
    points = _interpolate(mass, edges, u)
    middles = 0.5 * (points[..., 1:] + points[..., :-1])
    first = (2 * points[..., :1] - middles[..., :1]).maximum(edges[..., :1])
    last = (2 * points[..., -1:] - middles[..., -1:]).minimum(edges[..., -1:])
    return torch.cat([first, middles, last], -1)


def _interpolate(x: Tensor, y: Tensor, at: Tensor) -> Tensor:
    """The piecewise linear function through (x, y) (..., S + 1) at points (..., N); constant outside."""
    below = (torch.searchsorted(x, at, right=True) - 1).clamp(0, x.shape[-1] - 2)
    x0, x1 = x.gather(-1, below), x.gather(-1, below + 1)
    share = ((at - x0) / (x1 - x0).clamp_min(torch.finfo(x.dtype).tiny)).clamp(0, 1)
    return torch.lerp(y.gather(-1, below), y.gather(-1, below + 1), share)


@torch.no_grad()
def anneal(weights: Tensor, progress: float, slope: float = 10.0) -> Tensor:
    """weights^b with b from 0 to 1 as progress does (Schlick's bias; mip-NeRF 360, eq. 18): flat at the start."""
    return weights ** anneal_exponent(progress, slope)


def anneal_exponent(progress: float, slope: float = 10.0) -> float:
    """Of `anneal`."""
    return slope * progress / ((slope - 1) * progress + 1)


@torch.no_grad()
def resample_blurred(edges: Tensor, weights: Tensor, half_width: float, at: Tensor) -> Tensor:
    """Mass of the blurred function between neighbouring points.

    The blurred function's running mass at x is the mean of the sharp one's over [x - half_width, x + half_width],
    which is a difference of the latter's integral: piecewise quadratic, and exact without sorting any knots.
    In float64, since the difference cancels.

    Args:
        edges: (..., S + 1). weights: (..., S).
        half_width: > 0, in the unit of the edges.
        at: (..., N + 1) ascending points.

    Returns:
        (..., N).
    """
    if edges.device.type == "cpu":
        arrays = (edges, weights, at)
        return step_kernels.run(step_kernels.resample_blurred, [at.shape[-1] - 1], arrays, half_width)[0]
    return _resample_blurred_torch(edges, weights, half_width, at).to(weights)


def _resample_blurred_torch(edges: Tensor, weights: Tensor, half_width: float, at: Tensor) -> Tensor:
    edges, weights, at = edges.double(), weights.double(), at.double()
    width = edges.diff(dim=-1)
    mass = torch.nn.functional.pad(weights.cumsum(-1), (1, 0))
    integral = torch.nn.functional.pad((width * (mass[..., :-1] + 0.5 * weights)).cumsum(-1), (1, 0))
    x = torch.cat([at - half_width, at + half_width], -1)
    inside = x.maximum(edges[..., :1]).minimum(edges[..., -1:])
    index = (torch.searchsorted(edges, inside, right=True) - 1).clamp_max(weights.shape[-1] - 1)
    offset = inside - edges.gather(-1, index)
    density = weights / width.clamp_min(torch.finfo(width.dtype).tiny)
    start = mass.gather(-1, index) + 0.5 * offset * density.gather(-1, index)
    total = integral.gather(-1, index) + offset * start + mass[..., -1:] * (x - inside).clamp_min(0)
    below, above = total.chunk(2, -1)
    return (above - below).diff(dim=-1) / (2 * half_width)
