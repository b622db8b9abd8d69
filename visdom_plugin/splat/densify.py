"""Where Gaussians are added and removed (Kerbl et al. 2023, section 5; GaussianObject's floater removal; FSGS's
unpooling).

Pure functions that say what to change; GaussianOptimiser carries it out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.rotations import matrix_from_quaternion

GAUSSIANS_PER_PIECE = 4096


class Measured(NamedTuple):
    """What was seen of each Gaussian since the last densification."""

    gradient: Tensor
    """(N,) sum of the norms of the loss's gradient by the projected mean, in normalised device units."""
    seen: Tensor
    """(N,) in how many steps it was visible."""
    radius: Tensor
    """(N,) the largest on screen, in `unit`."""

    @classmethod
    def nothing(cls, n: int, device: torch.device) -> Measured:
        return cls(*(torch.zeros(n, device=device) for _ in range(3)))

    def after(self, info: Mapping[str, Any], unit: float) -> Measured:
        """With one more view, after its backward pass.

        Args:
            info: of its `Render`.
            unit: of the radii, in pixels.
        """
        gradient, visible, radii = info["means2d"].grad, info["visible"], info["radii"]
        half = info["width"] / 2, info["height"] / 2
        if gradient.device.type != "cpu" or gradient.dtype != torch.float32 or radii.ndim == 1:
            return self.after_by_torch(gradient, visible, radii, half, unit)
        before = [x.numpy() for x in self]
        after = [np.empty_like(x) for x in before]
        arrays = (x.contiguous().numpy() for x in (gradient, visible, radii))
        scales = (np.float32(x) for x in (*half, unit))
        parallel_for(_measure, len(before[0]), GAUSSIANS_PER_PIECE, *arrays, *scales, *before, *after)
        return Measured(*(torch.from_numpy(x) for x in after))

    def after_by_torch(
        self, gradient: Tensor, visible: Tensor, radii: Tensor, half: tuple[float, float], unit: float
    ) -> Measured:
        """The same on any device; radii may be (N,)."""
        # Numbers, not a tensor: a copy to the GPU would wait for it.
        u, v = gradient.unbind(-1)
        norm = torch.stack([u * half[0], v * half[1]], -1).norm(dim=-1)
        radii = radii if radii.ndim == 1 else radii.amax(-1)
        return Measured(
            self.gradient + torch.where(visible, norm, 0),
            self.seen + visible,
            torch.maximum(self.radius, torch.where(visible, radii, 0).float() / unit),
        )


@kernel(error_model="numpy")
def _measure(
    begin, end, slopes, visible, radii, half_width, half_height, unit, gradient, count, radius,
    new_gradient, new_count, new_radius,
):  # fmt: skip
    """Gaussians begin .. end - 1."""
    for i in range(begin, end):
        seen = np.float32(visible[i])
        u, v = slopes[i, 0] * half_width, np.float64(slopes[i, 1] * half_height)
        # Rounded as torch's norm is, once for the second square and the sum.
        norm = np.sqrt(np.float32(np.float64(u * u) + v * v))
        new_gradient[i] = gradient[i] + (norm if visible[i] else np.float32(0))
        new_count[i] = count[i] + seen
        new_radius[i] = max(radius[i], seen * np.float32(max(radii[i, 0], radii[i, 1])) / unit)


def initial_log_scales(means: Tensor) -> Tensor:
    """Isotropic log scales: root mean squared distance to the three nearest neighbours, as in 3DGS.

    Args:
        means: (N, 3), in a unit of about the scene's size: a lone Gaussian has scale 1, several at one place
            have 1e-7.

    Returns:
        (N, 3).
    """
    squared = _neighbours(means, min(4, len(means)))[0][:, 1:]
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
    squared = _neighbours(means, max(1, math.isqrt(len(means))))[0]
    return (squared.mean(-1) >= squared.mean() + sigmas * squared.std()).to(means.device)


def _neighbours(means: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """(N, count) squared distances, ascending, and the points' indices, on the CPU; the point itself is one."""
    from scipy.spatial import cKDTree

    points = means.detach().double().cpu().numpy()
    distances, nearest = cKDTree(points).query(points, k=count, workers=-1)
    squared, found = (np.asarray(x).reshape(len(points), count) for x in (distances**2, nearest))
    return torch.from_numpy(squared), torch.from_numpy(found)


NEIGHBOURS = 3
"""Of the proximity graph (FSGS)."""


class Proximity(NamedTuple):
    """The graph of each Gaussian's three nearest neighbours (Zhu et al., FSGS, 2024)."""

    score: Tensor
    """(N,) root mean squared distance to them."""
    nearest: Tensor
    """(N, 3) int64, which ones they are."""

    @classmethod
    def of(cls, means: Tensor) -> Proximity:
        """The graph of centres (N, 3), N >= 4, on their device."""
        squared, nearest = _neighbours(means, NEIGHBOURS + 1)
        # Of others at the same place any may come first, and the point itself need not be found.
        dropped = 2 * (nearest == torch.arange(len(means))[:, None]).int()
        dropped[:, 0] += 1
        others = dropped.argsort(dim=1, descending=True, stable=True)[:, 1:]
        score = squared.gather(1, others).mean(-1).sqrt()
        return cls(score.to(means), nearest.gather(1, others).to(means.device))


def unpooled(rows: dict[str, Tensor], proximity: Proximity, lonely: Tensor) -> dict[str, Tensor]:
    """New Gaussians halfway between lonely ones and their three nearest neighbours (FSGS).

    Scales and opacity are the neighbour's, the rotation is none and all harmonics are 0, which is grey.

    Args:
        rows: parameters (N, ...) by name.
        lonely: (N,) bool.

    Returns:
        Parameters (3 M, ...) by the same names for M lonely ones, neighbour by neighbour.
    """
    ends = proximity.nearest[lonely].reshape(-1)
    starts = lonely.nonzero()[:, 0].repeat_interleave(NEIGHBOURS)
    new = {name: value[ends] for name, value in rows.items()}
    new["means"] = (rows["means"][starts] + new["means"]) / 2
    new["quaternions"] = torch.zeros_like(new["quaternions"])
    new["quaternions"][:, 0] = 1
    new["sh"] = torch.zeros_like(new["sh"])
    return new


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
