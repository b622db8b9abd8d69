"""nerfacc (0.5): per-ray bounds for its estimators, and occupancy cells outside the hull that never come to life.

Nothing here imports nerfacc: the estimator is the caller's.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.geometry.local_frame import require_near
from visdom_plugin.hooks.protocols import SamplerHook
from visdom_plugin.hull.hull import Hull


def ray_limits(
    sampler: SamplerHook, rays_o: Tensor, rays_d: Tensor, near_plane: float = 0.0, far_plane: float = 1e10
) -> dict[str, Tensor]:
    """`t_min` and `t_max` (n_rays,) for `OccGridEstimator.sampling(rays_o, rays_d, **limits)`.

    Args:
        rays_o, rays_d: (n_rays, 3) world frame; directions of unit length, as nerfacc wants them.
        near_plane, far_plane: as handed to nerfacc.
    """
    near, far = (rays_d.new_full(rays_d.shape[:-1], plane) for plane in (near_plane, far_plane))
    near, far, _ = sampler.bound(rays_o, rays_d, near, far)
    return {"t_min": near, "t_max": far}


def ray_planes(
    sampler: SamplerHook, rays_o: Tensor, rays_d: Tensor, near_plane: float, far_plane: float
) -> dict[str, Tensor]:
    """`near_plane` and `far_plane` (n_rays, 1) for `PropNetEstimator.sampling(..., **planes)`.

    Its arithmetic takes a plane per ray as well as one for all. Arguments as in `ray_limits`.
    """
    limits = ray_limits(sampler, rays_o, rays_d, near_plane, far_plane)
    return {"near_plane": limits["t_min"][:, None], "far_plane": limits["t_max"][:, None]}


class Estimator(Protocol):
    """What is asked of an `OccGridEstimator`."""

    aabbs: Tensor
    """(levels, 6) lower and upper corner of each level."""
    resolution: Tensor
    """(3,) cells along x, y, z."""
    occs: Tensor
    """(cells,)"""
    binaries: Tensor
    """(levels, X, Y, Z) bool."""


@torch.no_grad()
def confine(estimator: Estimator, hull: Hull, *, margin: float = 0.0) -> int:
    """Closes, for good, the cells of an `OccGridEstimator` that the hull does not reach.

    They get occupancy -1, which nerfacc's updates pass over, as they do after `mark_invisible_cells`; the mark is
    part of the estimator's state dict. Call it once, before training, with the estimator where it will stay.

    Args:
        estimator: nerfacc's own.
        hull: in the estimator's frame.
        margin: cells up to this far from the hull stay open, in scene units; `sampler.epsilon_world` leaves open
            what the sampler's band reaches.

    Returns:
        How many cells stay open.

    Raises:
        ConfigError: when no cell stays open, or the boxes lie so far from the origin that nerfacc's float32 cannot
            hold them; the estimator is left as it was.
        PluginError: for nerfacc before 0.5.3, whose updates look at closed cells, too.
    """
    package = type(estimator).__module__.partition(".")[0]
    if package == "nerfacc" and _release(version(package)) < (0, 5, 3):
        raise PluginError(
            f"the updates of nerfacc {version(package)} open closed cells again",
            todo="pip install 'nerfacc>=0.5.3', or bound rays alone, with ray_limits",
        )
    innermost = estimator.aabbs[0].reshape(2, 3).cpu().numpy()
    require_near(innermost, float(np.ptp(innermost, axis=0).max()), f"aabbs {innermost.tolist()}")
    total = np.zeros(np.add(hull.shape, 1), np.int64)
    total[1:, 1:, 1:] = hull.occupancy.cumsum(0, dtype=np.int64).cumsum(1).cumsum(2)
    reached = []
    for box in estimator.aabbs.double().cpu().numpy():
        ends = []
        for axis, count in enumerate(estimator.resolution.tolist()):
            planes = np.linspace(box[axis], box[3 + axis], count + 1)
            low, high = planes[:-1] - margin, planes[1:] + margin
            edge, n = hull.voxel_edges[axis], hull.shape[axis]
            # Float32 corners of cells that share planes with voxels must not reach the neighbour by rounding.
            first = np.floor((low - hull.bounds[0, axis]) / edge + 1e-4)
            last = np.ceil((high - hull.bounds[0, axis]) / edge - 1e-4)
            ends.append((np.clip(first, 0, n).astype(int), np.clip(last, 0, n).astype(int)))
        inside = sum(
            (-1) ** (3 - i - j - k) * total[np.ix_(ends[0][i], ends[1][j], ends[2][k])]
            for i in (0, 1)
            for j in (0, 1)
            for k in (0, 1)
        )
        reached.append(inside > 0)
    if not np.any(reached):
        low, high = np.round(hull.extent, 3).tolist()
        raise ConfigError(
            f"the hull, from {low} to {high}, reaches no cell of the estimator",
            where=f"aabbs {estimator.aabbs.tolist()}",
            cause="a hull in another frame than the estimator's, or an empty one",
            todo="carve from the poses that the trainer trains with, or choose the estimator's box by hull.extent",
        )
    closed = torch.from_numpy(~np.stack(reached)).to(estimator.occs.device)
    estimator.occs[closed.flatten()] = -1.0
    estimator.binaries &= ~closed
    return int((~closed).sum())


def _release(text: str) -> tuple[int, ...]:
    """ "0.5.3+cu118" as (0, 5, 3)."""
    return tuple(int(part) for part in text.partition("+")[0].split(".")[:3] if part.isdecimal())
