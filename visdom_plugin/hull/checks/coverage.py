"""Coverage of masks by a hull: measured through every pixel, or estimated from a few rays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Silhouettes
from visdom_plugin.hull.checks.degenerate import (
    WRITTEN,
    count_cameras_inside,
    describe_speck,
    needs_several,
    stand_at_one_point,
)
from visdom_plugin.hull.foreign import to_numpy
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.hull.settings import HullSettings

POOR_COVERAGE, SOUND_COVERAGE = 0.7, 0.9
"""Mean share of the masks below which a hull does not explain them, and from which no question is asked. Sound
captures of two to nine views leave hulls that cover 96 % or more, inverted poses meetings of 1 % to 85 %."""
_RAYS, _STEPS = 512, 256
"""Of the estimate: over all views, and along each ray."""


class Coverage(NamedTuple):
    """How a hull's silhouette meets one view's mask."""

    covered: float
    """Share of the mask's pixels that the hull covers; 1 for an empty mask."""
    inside: float
    """Share of the hull's silhouette that lies on the mask; 1 where the hull is not seen."""


def measure_coverage(
    hull: Hull,
    cameras: Cameras,
    masks: Sequence[Tensor | np.ndarray],
    ignore: Sequence[Tensor | np.ndarray | None] = (),
) -> list[Coverage]:
    """Coverage of each mask, by casting a ray through every pixel.

    Args:
        cameras: (N,) cameras.
        masks: N tensors or arrays (H, W), True on the object.
        ignore: N tensors or arrays (H, W) bool or None, True where nothing is known, or empty: such pixels do not
            count.
    """
    result = []
    for view, mask in enumerate(masks):
        seen = depth_and_silhouette(hull, cameras[view].to("cpu"))[1].numpy()
        mask = to_numpy(mask).astype(bool)
        ignored = ignore[view] if ignore else None
        if ignored is not None:
            known = ~to_numpy(ignored).astype(bool)
            seen, mask = seen & known, mask & known
        both, of_mask, of_hull = (int(np.count_nonzero(x)) for x in (seen & mask, mask, seen))
        result.append(Coverage(both / of_mask if of_mask else 1.0, both / of_hull if of_hull else 1.0))
    return result


def looks_sound(settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes, hull: Hull) -> bool:
    """Whether a hull covers its masks by a quick estimate, and is closed and not degenerate; or was cut off on
    purpose."""
    if (settings.bounds, settings.sphere_centre, settings.sphere_radius) != (None, None, None):
        return True
    cameras, rule = cameras.to("cpu", dtype=torch.float64), KeepRule.of(settings, len(silhouettes))
    return (
        (hull.summary["bounds_closed"] or not needs_several(rule))
        and not stand_at_one_point(cameras, WRITTEN)
        and describe_speck(cameras, hull) is None
        and not count_cameras_inside(rule, cameras, hull)
        and estimate_coverage(hull, cameras, silhouettes) >= SOUND_COVERAGE
    )


def estimate_coverage(hull: Hull, cameras: Cameras, silhouettes: Silhouettes) -> float:
    """A quick lower estimate of the mean share of the masks that a hull covers, 1 when all are empty.

    A few rays of each mask, each looked up in the grid at a few points: what is thinner than their distance may
    be missed, nothing is seen that is not there.

    Args:
        cameras: (N,) on the CPU.
    """
    known = silhouettes.demanding()
    count = max(_RAYS // len(silhouettes), 16)
    shares = []
    for view in range(len(silhouettes)):
        foreground = np.flatnonzero(known.mask(view))
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
