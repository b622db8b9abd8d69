"""From a hull, its cameras and masks to the shape inside it."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np

from visdom_plugin.errors import ConfigError, EmptyHullError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, gather_silhouettes
from visdom_plugin.hull.grid.components import find_pieces
from visdom_plugin.hull.hull import Hull, occupied_box
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.hull.inside.diffusion import NOTHING, cut_level, diffuse
from visdom_plugin.hull.inside.photo_consistency import PhotoConsistency
from visdom_plugin.hull.inside.pyramid import pool, refine
from visdom_plugin.hull.inside.silhouette_rays import draw_rays, give_back

log = logging.getLogger(__name__)

_LEAST_VIEWS = 3
_COARSEST = 40
"""Most voxels along the longest side of the coarsest grid."""
_LEAST_STEPS = 8
_PHOTO_EVERY = 4
"""Steps between two looks at the photographs."""
_BALL = 3.0
"""Radius in voxels of what a ray that misses the shape is given. The blur overlooks a single voxel: the shape
would go on shrinking past it, and nothing but sheets of such voxels would stay."""


def shape_inside(
    hull: Hull,
    cameras: Cameras,
    masks: Sequence,
    ignore: Sequence = (),
    config: InsideConfig | None = None,
    images: Sequence | None = None,
) -> Hull:
    """The smoothest full shape inside a hull that covers of the masks what the hull covers; see `InsideConfig`.

    Args:
        hull: carved from these cameras and masks.
        cameras: (N,) cameras.
        masks: N tensors or arrays (H, W), True on the object.
        ignore: N tensors or arrays (H, W) bool or None, True where nothing is known, or empty.
        images: N tensors or arrays (H, W, 3), the photographs: `config.photo_weight` is about them. Without them
            silhouettes alone decide.

    Returns:
        A Hull on the hull's own grid, each of its voxels one of the hull's. Its summary is the hull's with kind
        "inside", `coverage`, the share of each mask that it covers, and its own pieces and seconds.

    Raises:
        ConfigError: fewer than three views, or a hull for which one view was enough (silhouettes say too little
            then about the shape inside), or voxels that are no cubes.
        EmptyHullError: the hull holds no voxel.
        SceneError: masks do not fit the cameras.
    """
    config = config or InsideConfig()
    silhouettes = gather_silhouettes(cameras, masks, ignore).demanding()
    _check(hull, len(silhouettes))
    began = time.perf_counter()
    box = occupied_box(hull.occupancy)
    window = tuple(slice(a, b) for a, b in box.T)
    grid = Grid(hull.bounds[0] + box[0] * hull.voxel_edges, hull.voxel_size, tuple(box[1] - box[0]))
    radius = config.radius * hull.radius
    photographs = None
    if images is not None and config.photo_weight > 0:
        photographs = PhotoConsistency(cameras.to("cpu"), silhouettes, images, config.photo_tolerance)
    u, blurred = _flow(
        hull.occupancy[window], grid, radius, cameras.to("cpu"), silhouettes, config, photographs
    )
    cap = pool(hull.occupancy[window], 1)
    u = (u > 0.5).astype(np.float32)
    cut = cut_level(radius / grid.voxel)
    covered = [
        _cover(u, cap, blurred, cut, grid, cameras[i : i + 1].to("cpu"), silhouettes.mask(i))
        for i in range(len(silhouettes))
    ]
    occupancy = np.zeros_like(hull.occupancy)
    occupancy[window] = u
    pieces = len(find_pieces(occupancy).sizes)
    summary = {
        **hull.summary,
        "kind": "inside",
        "hull_kind": hull.summary.get("kind"),
        "radius": config.radius,
        "coverage": covered,
        "components": pieces,
        "components_found": pieces,
        "components_dropped": "",
        "seconds": round(time.perf_counter() - began, 4),
    }
    result = Hull(occupancy, hull.bounds, summary)
    log.info(
        "shape inside the hull: %.0f%% of its volume, at least %.1f%% of each mask covered, %.2f s",
        100 * result.voxels / hull.voxels, 100 * min(covered), summary["seconds"],
    )  # fmt: skip
    return result


def _check(hull: Hull, views: int) -> None:
    if views < _LEAST_VIEWS:
        raise ConfigError(
            f"the shape inside a hull cannot be found from {views} views",
            cause="so few silhouettes are reproduced by thin sheets, too",
            todo=f"use the hull itself, or {_LEAST_VIEWS} views or more",
        )
    kind, k = hull.summary.get("kind", "visdom"), hull.summary.get("k", 2)
    if kind in ("traditional", "unit-sphere") or (kind == "visdom" and k < 2):
        raise ConfigError(
            f"the shape inside a hull of kind {kind} with K = {k} cannot be found",
            cause="one view is enough for its voxels, so that it reaches to the cameras and is open there",
            todo="carve with k of 2 or more",
        )
    if not np.allclose(hull.voxel_edges, hull.voxel_size, rtol=1e-3):
        raise ConfigError(
            f"the hull's voxels are no cubes: {np.array2string(hull.voxel_edges, precision=4)}",
            todo="resample the grid to cubic voxels, or carve the hull here",
        )
    if not hull.voxels:
        raise EmptyHullError("the hull holds no voxel, so there is no shape inside it")


def _flow(
    inside: np.ndarray,
    grid: Grid,
    radius: float,
    cameras: Cameras,
    silhouettes: Silhouettes,
    config: InsideConfig,
    photographs: PhotoConsistency | None,
) -> tuple[np.ndarray, np.ndarray]:
    """The shape u and the blurred shape on `grid`, float32, from coarse to fine; `radius` in scene units."""
    longest, finest = max(grid.shape), 1
    while config.resolution is not None and longest > finest * config.resolution:
        finest *= 2
    factor = finest
    while longest > factor * _COARSEST:
        factor *= 2
    cap, steps = pool(inside, factor), config.steps
    u = cap.astype(np.float32)
    while True:
        level = Grid(grid.lower, grid.voxel * factor, cap.shape)
        rays = draw_rays(cameras, silhouettes, level).that_meet(cap)
        half, blurred, missed = np.empty_like(u), u.copy(), 0
        against: np.ndarray = NOTHING
        for step in range(steps):
            if photographs is not None and step % _PHOTO_EVERY == 0:
                against = np.float32(config.photo_weight) * photographs.contradiction(u, blurred, level)
            diffuse(u, cap, radius / level.voxel, half, blurred, against)
            missed = give_back(rays, u, cap, blurred, cut_level(radius / level.voxel), _BALL)
        log.debug("%s voxels: %d of %d rays missed in the last step", cap.shape, missed, len(rays))
        if factor == finest:
            break
        factor, steps = factor // 2, max(steps // 2, _LEAST_STEPS)
        cap = pool(inside, factor)
        u = refine(u, cap.shape) * cap
    while factor > 1:
        factor //= 2
        cap = pool(inside, factor)
        u, blurred = refine(u, cap.shape) * cap, refine(blurred, cap.shape)
    return u, blurred


def _cover(
    u: np.ndarray,
    cap: np.ndarray,
    blurred: np.ndarray,
    cut: float,
    grid: Grid,
    camera: Cameras,
    mask: np.ndarray,
) -> float:
    """Gives every pixel of a mask that the hull covers and the shape does not a voxel; the share covered then."""
    rays = draw_rays(camera, gather_silhouettes(camera, [mask]), grid, every_pixel=True).that_meet(cap)
    give_back(rays, u, cap, blurred, cut)
    return round(len(rays) / max(int(np.count_nonzero(mask)), 1), 6)
