"""The step functions' loops for the CPU: one pass along each ray where torch needs a search and four gathers.

Arrays are (rays, ...) in one floating dtype; sums are kept in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

RAYS_PER_PIECE = 128
LEAST_WEIGHT = 1e-12  # so that a ray that meets nothing is sampled evenly over its intervals


def run(
    kernel, columns: Sequence[int], arrays: Sequence[Tensor], *scalars: float | np.floating[Any]
) -> list[Tensor]:
    """Runs a kernel over rays.

    Args:
        kernel: called with begin, end, the arrays, the scalars and the outputs.
        columns: C of each result.
        arrays: (..., C_k) tensors on the CPU, whose leading dimensions broadcast. The first gives the dtype.

    Returns:
        (..., C) for each result.
    """
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    flat = [
        x.detach()
        .to(arrays[0].dtype)
        .expand(*lead, x.shape[-1])
        .reshape(-1, x.shape[-1])
        .contiguous()
        .numpy()
        for x in arrays
    ]
    out = [np.empty((len(flat[0]), c), flat[0].dtype) for c in columns]
    parallel_for(kernel, len(flat[0]), RAYS_PER_PIECE, *flat, *scalars, *out)
    return [torch.from_numpy(x).reshape(*lead, x.shape[1]) for x in out]


@kernel(error_model="numpy")
def sample(begin, end, edges, weights, jitter, near, far, exponent, power, inverse, factor, out, distances):
    """New edges by the weights to the power `exponent`, and, if asked for, where they lie between near and far
    (rays, 1): see `ray_warp.distances_of`, with `inverse` of the power, and `factor` as there.

    `exponent` and `inverse` are of the arrays' type, since it takes twice as long to find a power in float64.
    """
    count, warped = out.shape[1] - 1, distances.shape[1] > 0
    last = weights.shape[1] - 1
    step = 1 if jitter.shape[1] > 1 else 0
    masses = np.empty(last + 1)
    for ray in range(begin, end):
        total = 0.0
        for i in range(last + 1):
            weight = weights[ray, i] if exponent == 1 else math.pow(weights[ray, i], exponent)
            masses[i] = max(np.float64(weight), LEAST_WEIGHT)
            total += masses[i]
        i, below = 0, 0.0
        first, point = 0.0, 0.0
        for k in range(count):
            u = (k + np.float64(jitter[ray, k * step])) / count * total
            while i < last and below + masses[i] <= u:
                below += masses[i]
                i += 1
            share = min((u - below) / masses[i], 1.0)
            previous, point = point, edges[ray, i] + share * (np.float64(edges[ray, i + 1]) - edges[ray, i])
            if k == 0:
                first = point
            else:
                out[ray, k] = 0.5 * (previous + point)
        out[ray, 0] = max(2 * first - out[ray, 1], edges[ray, 0])
        out[ray, count] = min(2 * point - out[ray, count - 1], edges[ray, last + 1])
        if warped:
            low, high = np.float64(near[ray, 0]), np.float64(far[ray, 0])
            if power != 1:
                low, high = (low * factor + 1) ** power, (high * factor + 1) ** power
            for k in range(count + 1):
                s = np.float64(out[ray, k])
                distances[ray, k] = low * (1 - s) + high * s
                if power != 1:
                    t = (math.pow(distances[ray, k], inverse) - 1.0) / factor
                    distances[ray, k] = min(max(t, near[ray, 0]), far[ray, 0])


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


@kernel(error_model="numpy")
def distortion(begin, end, edges, weights, out):
    """The slopes by the weights (rays, S), then, in a last column, the loss.

    It is w' Q w, with the matrix Q of mean distances; Q w takes two running sums.
    """
    n = weights.shape[1]
    for ray in range(begin, end):
        start, all_mass, all_moment = np.float64(edges[ray, 0]), 0.0, 0.0
        for i in range(n):
            all_mass += weights[ray, i]
            all_moment += weights[ray, i] * (0.5 * (edges[ray, i] + np.float64(edges[ray, i + 1])) - start)
        mass, moment, total = 0.0, 0.0, 0.0
        for i in range(n):
            weight = np.float64(weights[ray, i])
            middle = 0.5 * (edges[ray, i] + np.float64(edges[ray, i + 1])) - start
            mass += weight
            moment += weight * middle
            distance = middle * (2 * mass - all_mass) - (2 * moment - all_moment)
            distance += weight * (np.float64(edges[ray, i + 1]) - edges[ray, i]) / 3
            out[ray, i] = 2 * distance
            total += weight * distance
        out[ray, n] = total
