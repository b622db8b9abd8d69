"""Where Gaussians are added and removed (Kerbl et al. 2023, section 5; GaussianObject's floater removal).

Pure functions that say what to change; GaussianOptimiser carries it out.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.rotations import matrix_from_quaternion


def initial_log_scales(means: Tensor) -> Tensor:
    """Isotropic log scales: root mean squared distance to the three nearest neighbours, as in 3DGS.

    Args:
        means: (N, 3), in a unit of about the scene's size: a lone Gaussian has scale 1, several at one place
            have 1e-7.

    Returns:
        (N, 3).
    """
    squared = _squared_neighbour_distances(means, min(4, len(means)))[:, 1:]
    mean = squared.mean(-1) if squared.shape[1] else torch.ones(len(means))
    return 0.5 * mean.clamp_min(1e-14).log().to(means)[:, None].repeat(1, 3)


def stray_gaussians(means: Tensor, sigmas: float) -> Tensor:
    """Gaussians far from their neighbours, GaussianObject's statistical floater removal.

    Of each Gaussian the squared distances to its floor(sqrt(N)) nearest neighbours, itself included, are
    averaged; it is stray when that mean reaches mean + sigmas * std of all distances.

    Args:
        means: (N, 3).
        sigmas: threshold in standard deviations.

    Returns:
        (N,) bool, True for stray ones.
    """
    squared = _squared_neighbour_distances(means, max(1, math.isqrt(len(means))))
    return (squared.mean(-1) >= squared.mean() + sigmas * squared.std()).to(means.device)


def _squared_neighbour_distances(means: Tensor, count: int) -> Tensor:
    """(N, count) ascending, the first is the point itself."""
    from scipy.spatial import cKDTree

    points = means.detach().double().cpu().numpy()
    distances, _ = cKDTree(points).query(points, k=count, workers=-1)
    return torch.from_numpy(np.asarray(distances, dtype=np.float64).reshape(len(points), count) ** 2)


def split_children(rows: dict[str, Tensor], generator: Generator) -> dict[str, Tensor]:
    """Two children per Gaussian: centres drawn from it, scales divided by 1.6 (3DGS).

    Args:
        rows: parameters (N, ...) by name, with means, log_scales and quaternions among them.
        generator: CPU generator.

    Returns:
        Parameters (2N, ...) by the same names.
    """
    children = {name: torch.cat([value, value]) for name, value in rows.items()}
    noise = torch.randn(children["means"].shape, generator=generator).to(children["means"])
    offset = children["log_scales"].exp() * noise
    rotation = matrix_from_quaternion(children["quaternions"])
    children["means"] = children["means"] + (rotation @ offset[..., None])[..., 0]
    children["log_scales"] = children["log_scales"] - math.log(1.6)
    return children
