"""Points inside a hull: denser near its surface, which is what cameras see and all there is of thin parts; or one
in each voxel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin.hull.hull import Hull, occupied_box

DEPTH = 0.08
"""Thickness of the shell below the surface, in radii of the hull."""
DEEP = 0.2
"""Density below the shell, where that in it is 1."""


def sample_shell(hull: Hull, n: int, generator: Generator | None = None) -> Tensor:
    """Points inside, uniform in the shell of `DEPTH` radii below the surface and `DEEP` times as dense below it.

    Args:
        n: how many.
        generator: CPU generator; torch's global one without.

    Returns:
        (n, 3) float64, world frame; (0, 3) for an empty hull.
    """
    if not hull.voxels:
        return torch.zeros(0, 3, dtype=torch.float64)
    index, cumulative = hull._once("shell", lambda: _weigh(hull))
    draw = torch.rand(n, 4, generator=generator, dtype=torch.float64).numpy()
    chosen = np.searchsorted(cumulative, draw[:, 0] * cumulative[-1], side="right")
    corner = index[np.minimum(chosen, len(index) - 1)]
    return torch.from_numpy(hull.bounds[0] + (corner + draw[:, 1:]) * hull.voxel_edges)


def voxel_centres(hull: Hull, n: int, generator: Generator | None = None) -> Tensor:
    """Centres of the hull's voxels; where there are more than `n`, n of them, drawn without replacement.

    Args:
        n: how many at most.
        generator: CPU generator; torch's global one without.

    Returns:
        (m, 3) float64, world frame, m <= n; (0, 3) for an empty hull.
    """
    index = np.argwhere(hull.occupancy)
    if len(index) > n:
        index = index[torch.randperm(len(index), generator=generator)[:n].sort().values.numpy()]
    return torch.from_numpy(hull.bounds[0] + (index + 0.5) * hull.voxel_edges)


def _weigh(hull: Hull) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) indices of the occupied voxels, and (V,) running sums of their densities."""
    from scipy.ndimage import distance_transform_edt

    lower, upper = occupied_box(hull.occupancy).astype(int)
    window = hull.occupancy[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))]
    # Beyond the window there is nothing, though it may be all occupied.
    depth = distance_transform_edt(np.pad(window, 1), sampling=hull.voxel_edges)[1:-1, 1:-1, 1:-1]
    index = np.argwhere(window)
    shallow = depth[window] <= DEPTH * hull.radius
    return index + lower, np.cumsum(np.where(shallow, 1.0, DEEP))
