"""Whether a hull explains the masks it was carved from: one carved with wrong poses is seldom empty.

Sound captures of two to nine views leave hulls that cover 96 % of the masks or more in the mean; world-to-camera
matrices taken for their inverses leave chance meetings of the views that cover 1 % to 52 %.
"""

from __future__ import annotations

import logging

import numpy as np
import torch

from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.hull.carving.votes import Silhouettes
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.checks.explain_failure import COMMAND, find_convention
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.settings import HullSettings

log = logging.getLogger(__name__)

_POOR = 0.7
"""Mean share of the masks below which a hull does not explain them."""
_SPECK = 1e-3
"""Of the cameras' distance: a hull smaller than this is no object that a camera was pointed at."""
_RAYS, _STEPS = 512, 256
"""Of the first look, over all views, and along each ray."""


def find_misfit(domain: HullSettings, cameras: Cameras, silhouettes: Silhouettes, hull: Hull) -> str | None:
    """A sentence for the user when the hull leaves most of the masks uncovered, or None.

    Raises:
        SceneError: when poses of another convention explain the masks, or the hull is a mere speck.
    """
    if domain.bounds is not None or domain.sphere_centre is not None or domain.sphere_radius is not None:
        return None  # cut off on purpose
    cameras = cameras.to("cpu", dtype=torch.float64)
    if glance(hull, cameras, silhouettes) >= _POOR:
        return None
    masks = [silhouettes.mask(i) for i in range(len(silhouettes))]
    seen = measure_coverage(hull, cameras, masks)
    covered = float(np.mean([c.covered for c, mask in zip(seen, masks, strict=True) if mask.any()]))
    if covered >= _POOR:
        return None
    what = f"the hull does not explain the masks: it covers {covered:.0%} of them in the mean"
    log.info("%s; trying other conventions of the poses", what)
    found = find_convention(domain, cameras, silhouettes)
    if found is not None:
        cause, todo, where = found
        raise SceneError(what, where=where, cause=cause, todo=todo)
    size = np.ptp(hull.extent, axis=0).max()
    distance = (cameras.centres - torch.from_numpy(hull.centre)).norm(dim=-1).median().item()
    todo = f"look at each view's part in it: {COMMAND}"
    if size < _SPECK * distance:
        raise SceneError(
            f"{what}, and is a speck: {size:.2g} long, {distance:.2g} from the cameras",
            where="camera poses",
            cause="poses or intrinsics that do not belong to these masks, so that views meet only by chance",
            todo=todo,
        )
    few = f", or too little is seen by K = {domain.k} views" if domain.kind == "visdom" else ""
    return f"{what}; poses, intrinsics or masks of some views are wrong{few}; {todo}"


def glance(hull: Hull, cameras: Cameras, silhouettes: Silhouettes) -> float:
    """A quick lower estimate of the mean share of the masks that a hull covers, 1 when all are empty.

    A few rays of each mask, each looked up in the grid at a few points: what is thinner than their distance may
    be missed, nothing is seen that is not there.

    Args:
        cameras: (N,) on the CPU.
    """
    count = max(_RAYS // len(silhouettes), 16)
    shares = []
    for view in range(len(silhouettes)):
        foreground = np.flatnonzero(silhouettes.mask(view))
        if not len(foreground):
            continue
        chosen = foreground[(np.arange(count) + 0.5).astype(int) * len(foreground) // count]
        v, u = np.divmod(chosen, silhouettes.sizes[view, 0])
        rays = rays_of(cameras[view], torch.from_numpy(np.stack([u, v], -1) + 0.5))
        shares.append(_meet(hull, rays.origins.numpy(), rays.directions.numpy()).mean())
    return float(np.mean(shares)) if shares else 1.0


def _meet(hull: Hull, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(P,) bool: whether one of the points along each ray (P, 3) in the grid's box is occupied."""
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = (hull.bounds[:, None] - origins) / directions
    near, far = np.nanmax(planes.min(0), 1).clip(0), np.nanmin(planes.max(0), 1)
    along = near[:, None] + (far - near)[:, None] * (np.arange(_STEPS) + 0.5) / _STEPS
    points = origins[:, None] + along[..., None] * directions[:, None]
    index = np.floor((points - hull.bounds[0]) / hull.voxel_edges)
    inside = ((index >= 0) & (index < hull.shape)).all(-1) & (near < far)[:, None]
    x, y, z = np.where(inside[..., None], index, 0).astype(int).transpose(2, 0, 1)
    return (inside & hull.occupancy[x, y, z]).any(1)
