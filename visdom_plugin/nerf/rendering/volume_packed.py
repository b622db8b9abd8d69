"""Volume rendering of ragged samples: those of all rays one after another, as an occupancy grid leaves them.

Ray r owns the samples ray_offsets[r] to ray_offsets[r + 1] - 1, in ascending distance, with gaps where space
was skipped. On the CPU one kernel goes along each ray, forward and back; elsewhere the same in plain torch.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.nerf.rendering.volume import EMPTY, MAX_DENSITY

RAYS_PER_PIECE = 64
OPAQUE = 200.0  # optical depth at which nothing is left in float32, nor in what float64 needs


def offsets_of(ray: Tensor, n_rays: int) -> Tensor:
    """ray_offsets (n_rays + 1,) int64 of sorted ray numbers (M,)."""
    return torch.searchsorted(ray, torch.arange(n_rays + 1, device=ray.device))


def composite_packed(
    density: Tensor, rgb: Tensor, starts: Tensor, ends: Tensor, ray_offsets: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour, alpha and depth of rays.

    Args:
        density: (M,) per length, >= 0; infinity is allowed. Differentiable.
        rgb: (M, 3). Differentiable.
        starts, ends: (M,) distances along the ray of each sample's interval. Constants.
        ray_offsets: (n_rays + 1,) int64 ascending from 0 to M.
        background: (n_rays, 3) colour behind the last sample. Differentiable.

    Returns:
        rgb (n_rays, 3) over the background; alpha (n_rays,) in [0, 1]; depth (n_rays,), the mean of the
        intervals' middles by weight, which goes to the last end as alpha falls below 1e-6, and is 0 for a ray
        without samples; and the weights (M,), detached.
    """
    density = density.clamp_max(MAX_DENSITY)
    run = _Composite.apply if density.device.type == "cpu" else _composite_torch
    return run(density, rgb, starts.detach(), ends.detach(), ray_offsets, background)


def _composite_torch(density, rgb, starts, ends, ray_offsets, background):
    """The same on any device. Sums per ray are differences of running sums, in float64, so they are exact enough
    and do not depend on the order of threads."""
    first, last = ray_offsets[:-1], ray_offsets[1:]

    def sum_per_ray(values: Tensor) -> Tensor:
        running = torch.cat([values.new_zeros(1, values.shape[1]), values.cumsum(0)])
        return running[last] - running[first]

    depth = ((ends - starts) * density).double().clamp_max(OPAQUE)
    running = torch.cat([depth.new_zeros(1), depth.cumsum(0)])
    ray = torch.repeat_interleave(
        torch.arange(len(first), device=first.device), last - first, output_size=len(density)
    )
    weights = torch.exp(running[first][ray] - running[:-1]) * -torch.expm1(-depth)
    middles = (0.5 * (starts + ends)).double()[:, None]
    sums = sum_per_ray(weights[:, None] * torch.cat([rgb.double(), torch.ones_like(middles), middles], 1))
    alpha = sums[:, 3]
    colour = sums[:, :3] + (1 - alpha)[:, None] * background
    far = torch.where(last > first, torch.cat([ends.new_zeros(1), ends])[last], 0)
    distance = (sums[:, 4] + EMPTY * far) / (alpha + EMPTY)
    return colour.to(rgb), alpha.to(rgb), distance.to(rgb), weights.detach().to(density)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density, rgb, starts, ends, ray_offsets, background):
        n = len(ray_offsets) - 1
        arrays = [
            x.detach().contiguous().numpy() for x in (density, rgb, starts, ends, ray_offsets, background)
        ]
        real = arrays[0].dtype
        colour, alpha, depth = np.empty((n, 3), real), np.empty(n, real), np.empty(n, real)
        weights, passed = np.empty(len(density), real), np.empty(len(density), real)
        parallel_for(compose, n, RAYS_PER_PIECE, *arrays, colour, alpha, depth, weights, passed)
        ctx.arrays = (*arrays[1:], alpha, depth, weights, passed)
        out = [torch.from_numpy(x) for x in (colour, alpha, depth, weights)]
        ctx.mark_non_differentiable(out[3])
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_colour, by_alpha, by_depth, _):
        rgb = ctx.arrays[0]
        n = len(by_alpha)
        by_density, by_rgb, by_background = (
            np.empty_like(rgb[:, 0]),
            np.empty_like(rgb),
            np.empty((n, 3), rgb.dtype),
        )
        given = [g.contiguous().numpy() for g in (by_colour, by_alpha, by_depth)]
        parallel_for(compose_back, n, RAYS_PER_PIECE, *ctx.arrays, *given, by_density, by_rgb, by_background)
        by_density, by_rgb, by_background = (torch.from_numpy(x) for x in (by_density, by_rgb, by_background))
        return by_density, by_rgb, None, None, None, by_background


@kernel(error_model="numpy")
def compose(
    begin, end, density, rgb, starts, ends, offsets, background, colour, alpha, depth, weights, passed
):
    for ray in range(begin, end):
        transmittance, red, green, blue, total, distance = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            through = np.exp(-np.float64(density[i]) * (ends[i] - starts[i]))
            weight = transmittance * (1.0 - through)
            transmittance *= through
            weights[i], passed[i] = weight, transmittance
            total += weight
            red += weight * rgb[i, 0]
            green += weight * rgb[i, 1]
            blue += weight * rgb[i, 2]
            distance += weight * 0.5 * (starts[i] + ends[i])
        far = ends[offsets[ray + 1] - 1] if offsets[ray + 1] > offsets[ray] else 0.0
        colour[ray, 0] = red + (1.0 - total) * background[ray, 0]
        colour[ray, 1] = green + (1.0 - total) * background[ray, 1]
        colour[ray, 2] = blue + (1.0 - total) * background[ray, 2]
        alpha[ray] = total
        depth[ray] = (distance + EMPTY * far) / (total + EMPTY)


@kernel(error_model="numpy")
def compose_back(
    begin, end, rgb, starts, ends, offsets, background, alpha, depth, weights, passed,
    by_colour, by_alpha, by_depth, by_density, by_rgb, by_background,
):  # fmt: skip
    """With q the loss's slope by a weight, the slope by the optical depth of sample i is
    transmittance_{i+1} q_i - sum_{j > i} weight_j q_j: it ends more rays at i, and hides what is behind."""
    for ray in range(begin, end):
        red, green, blue = by_colour[ray, 0], by_colour[ray, 1], by_colour[ray, 2]
        by_distance = by_depth[ray] / (alpha[ray] + EMPTY)
        base = np.float64(by_alpha[ray]) - (
            red * background[ray, 0] + green * background[ray, 1] + blue * background[ray, 2]
        )
        hidden = 0.0
        for i in range(offsets[ray + 1] - 1, offsets[ray] - 1, -1):
            slope = base + red * rgb[i, 0] + green * rgb[i, 1] + blue * rgb[i, 2]
            slope += by_distance * (0.5 * (starts[i] + ends[i]) - depth[ray])
            by_density[i] = (ends[i] - starts[i]) * (passed[i] * slope - hidden)
            hidden += weights[i] * slope
            by_rgb[i, 0], by_rgb[i, 1], by_rgb[i, 2] = weights[i] * red, weights[i] * green, weights[i] * blue
        for c in range(3):
            by_background[ray, c] = (1.0 - alpha[ray]) * by_colour[ray, c]
