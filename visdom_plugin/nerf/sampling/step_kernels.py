"""The step functions' loops for the CPU: one pass along each ray where torch needs a search and four gathers.

Arrays are (rays, ...) in one floating dtype; sums are kept in float64.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

RAYS_PER_PIECE = 128
LEAST_WEIGHT = 1e-12  # so that a ray that meets nothing is sampled evenly over its intervals


def run(kernel, columns: int, arrays: tuple[Tensor, ...], *scalars: float) -> Tensor:
    """Runs a kernel over rays.

    Args:
        kernel: called with begin, end, the arrays, the scalars and the output.
        columns: C of the result.
        arrays: (..., C_k) tensors on the CPU, whose leading dimensions broadcast. The first gives the dtype.

    Returns:
        (..., C).
    """
    lead = torch.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    flat = [
        x.detach()
        .to(arrays[0].dtype)
        .expand(*lead, x.shape[-1])
        .reshape(-1, x.shape[-1])
        .contiguous()
        .numpy()
        for x in arrays
    ]
    out = np.empty((len(flat[0]), columns), flat[0].dtype)
    parallel_for(kernel, len(out), RAYS_PER_PIECE, *flat, *scalars, out)
    return torch.from_numpy(out).reshape(*lead, columns)


@kernel(error_model="numpy")
def sample(begin, end, edges, weights, jitter, out):
    count = out.shape[1] - 1
    last = weights.shape[1] - 1
    step = 1 if jitter.shape[1] > 1 else 0
    for ray in range(begin, end):
        total = 0.0
        for i in range(last + 1):
            total += max(np.float64(weights[ray, i]), LEAST_WEIGHT)
        i, below, mass = 0, 0.0, max(np.float64(weights[ray, 0]), LEAST_WEIGHT)
        first, point = 0.0, 0.0
        for k in range(count):
            u = (k + np.float64(jitter[ray, k * step])) / count * total
            while i < last and below + mass <= u:
                below += mass
                i += 1
                mass = max(np.float64(weights[ray, i]), LEAST_WEIGHT)
            share = min((u - below) / mass, 1.0)
            previous, point = point, edges[ray, i] + share * (np.float64(edges[ray, i + 1]) - edges[ray, i])
            if k == 0:
                first = point
            else:
                out[ray, k] = 0.5 * (previous + point)
        out[ray, 0] = max(2 * first - out[ray, 1], edges[ray, 0])
        out[ray, count] = min(2 * point - out[ray, count - 1], edges[ray, last + 1])


@kernel(error_model="numpy")
def resample_blurred(begin, end, edges, weights, at, half_width, out):
    """Once along the edges for the points plus the half width, once for those minus it."""
    n, points = weights.shape[1], at.shape[1]
    mass, integral, density = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
    running = np.empty(points)
    for ray in range(begin, end):
        t, w, x = edges[ray], weights[ray], at[ray]
        for i in range(n):
            width = np.float64(t[i + 1]) - t[i]
            density[i] = 0.5 * w[i] / width if width > 0 else 0.0
            mass[i + 1] = mass[i] + w[i]
            integral[i + 1] = integral[i] + width * (mass[i] + 0.5 * w[i])
        for sign in (-1, 1):
            i = 0
            for k in range(points):
                shifted = x[k] + sign * half_width
                while i < n and t[i + 1] <= shifted:
                    i += 1
                offset = max(shifted - t[i], 0.0)
                value = integral[i] + offset * (mass[i] + offset * density[i])
                running[k] = value if sign < 0 else (value - running[k]) / (2 * half_width)
        for k in range(points - 1):
            out[ray, k] = running[k + 1] - running[k]


@kernel(error_model="numpy")
def interlevel(begin, end, edges, weights, at, proposal, half_width, eps, out):
    """The loss's slopes by the proposal's weights (rays, P), then, in a last column, the loss."""
    n = proposal.shape[1]
    resample_blurred(begin, end, edges, weights, at, half_width, out)
    for ray in range(begin, end):
        total = 0.0
        for i in range(n):
            ratio = max(np.float64(out[ray, i]) - proposal[ray, i], 0.0) / (proposal[ray, i] + eps)
            total += ratio * ratio * (proposal[ray, i] + eps)
            out[ray, i] = -ratio * (2.0 + ratio)
        out[ray, n] = total
