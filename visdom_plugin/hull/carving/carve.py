"""The carve: from cameras and masks to a hull, as its settings say."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.areas import sum_areas
from visdom_plugin.hull.carving.bounds import Region, Search, cube_around, find_region, grid_in
from visdom_plugin.hull.carving.culling import explaining_pieces
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.octree import block_carve
from visdom_plugin.hull.carving.votes import Device, Grid, Silhouettes, dense_carve
from visdom_plugin.hull.grid.components import Pieces, choose_pieces, erase_pieces, find_pieces
from visdom_plugin.hull.hull import Hull, occupied_box
from visdom_plugin.hull.settings import HullSettings

Ball = tuple[np.ndarray, float]
"""Centre (3,) and radius, world units."""
_LOOSE, _TIGHTENINGS = 0.6, 3
"""Share of the grid's side below which what is kept gets a grid of its own, and how often."""


def carve_silhouettes(
    settings: HullSettings,
    cameras: Cameras,
    silhouettes: Silhouettes,
    *,
    device: Device = "cpu",
    effort: float = 1.0,
) -> Hull | None:
    """The hull, or None when nothing is left; `effort` as in `bounds.Search`."""
    rule = KeepRule.of(settings, len(silhouettes))
    started = time.perf_counter()
    fraction = 0.5 if settings.components == "largest" else settings.min_component_fraction
    search = Search(silhouettes, sum_areas(silhouettes), rule, settings.components, fraction, effort)
    summed = time.perf_counter()
    placed = _place(settings, cameras, search)
    if placed is None:
        return None
    grid, ball, closed = placed
    located = time.perf_counter()
    policy = _policy(settings, rule)
    found = _carve_grid(settings, policy, search, grid, ball, device)
    # Cells tell less than voxels: where the search kept what the voxels then lost, the grid shrinks to the rest.
    for _ in range(_TIGHTENINGS if policy == "explain" and settings.bounds is None else 0):
        if found is None:
            break
        occupancy, pieces, keep = found
        box = occupied_box(occupancy)
        if (box[1] - box[0]).max() > _LOOSE * settings.resolution:
            break
        if settings.bounds_scale > 1:
            break
        margin = np.array([[-1], [1]]) * (2 + 0.05 * (box[1] - box[0]).max())
        grid = cube_around(grid.lower + (box + margin) * grid.voxel, settings.resolution)
        found = _carve_grid(settings, policy, search, grid, ball, device)
    if found is None:
        return None
    occupancy, pieces, keep = found
    ended = time.perf_counter()
    summary: dict[str, Any] = {
        "kind": settings.kind,
        "views": len(silhouettes),
        "k": rule.least_visible,
        "agreement": None if rule.agreement is None else settings.agreement,
        "max_misses": rule.max_misses,
        "agreement_means": rule.meaning(),
        "resolution": settings.resolution,
        "components": int(keep.sum()),
        "components_found": len(keep),
        "components_rule": policy,
        "components_dropped": _say_dropped(pieces.sizes, keep, policy, settings.min_component_fraction),
        "voxels_dropped": int(pieces.sizes[~keep].sum()),
        "bounds_closed": closed,
        "dilate_px": settings.dilate_px,
        # Votes to grid, and the search for the bounds, which explicit bounds save.
        "seconds": round(ended - located + summed - started, 4),
        "bounds_seconds": round(located - summed, 4),
    }
    unknown = any(silhouettes.unknown_in(i) is not None for i in range(len(silhouettes)))
    if policy == "all" and unknown:
        explaining = explaining_pieces(pieces, occupancy, grid, silhouettes, rule, search.areas)
        summary["components_strays"] = int(np.count_nonzero(~explaining))
    if ball is not None:
        summary |= {"sphere_centre": [float(x) for x in ball[0]], "sphere_radius": float(ball[1])}
    return Hull(occupancy, grid.bounds, summary)


def _carve_grid(
    settings: HullSettings, policy: str, search: Search, grid: Grid, ball: Ball | None, device: Device
) -> tuple[np.ndarray, Pieces, np.ndarray] | None:
    """Occupancy after culling, its pieces before and which of them stayed; None for an empty grid."""
    silhouettes, areas, rule = search[:3]
    if str(device) == "cpu":
        occupancy = block_carve(silhouettes, grid, rule, areas)
    else:
        occupancy = dense_carve(silhouettes, grid, rule, device).cpu().numpy()
    if ball is not None:
        _clip_to_ball(occupancy, grid, *ball)
    pieces = find_pieces(occupancy)
    if len(pieces.sizes) == 0:
        return None
    if policy == "explain":
        keep = explaining_pieces(pieces, occupancy, grid, silhouettes, rule, areas)
    else:
        keep = choose_pieces(pieces.sizes, policy, settings.min_component_fraction)
    if not keep.all():
        erase_pieces(occupancy, pieces, keep)
    return occupancy, pieces, keep


def _place(settings: HullSettings, cameras: Cameras, search: Search) -> tuple[Grid, Ball | None, bool] | None:
    """Grid, ball (centre, radius) or None, and whether the views close the region; None for no region."""
    needs_ball, bounds = settings.kind == "unit-sphere", settings.bounds
    centre = None if settings.sphere_centre is None else np.array(settings.sphere_centre, np.float64)
    radius = settings.sphere_radius
    ball: Ball | None = None
    if needs_ball and centre is not None and radius is not None:
        ball = centre, float(radius)
    if bounds is not None and (ball is not None or not needs_ball):
        return grid_in(np.array(bounds, np.float64), settings.resolution), ball, True
    region = _visible_region(settings, cameras, search)
    if region is None:
        return None
    box = region.bounds
    if needs_ball:
        reach = float(np.linalg.norm(box[1] - box[0]) / 2) if radius is None else float(radius)
        ball = box.mean(0) if centre is None else centre, reach
    if bounds is not None:
        return grid_in(np.array(bounds, np.float64), settings.resolution), ball, True
    if ball is not None:
        box = np.stack([ball[0] - ball[1], ball[0] + ball[1]])
    elif _one_view_is_enough(settings, search.rule):
        centres = cameras.centres.double().cpu().numpy()
        box = np.stack([np.minimum(box[0], centres.min(0)), np.maximum(box[1], centres.max(0))])
    middle = box.mean(0)
    box = middle + settings.bounds_scale * (box - middle)
    return cube_around(box, settings.resolution), ball, region.closed


def _one_view_is_enough(settings: HullSettings, rule: KeepRule) -> bool:
    return settings.kind == "traditional" or (settings.kind == "visdom" and rule.least_visible == 1)


def _policy(settings: HullSettings, rule: KeepRule) -> str:
    """The policy on the grid's pieces."""
    baseline = settings.kind == "unit-sphere" or _one_view_is_enough(settings, rule)
    return "drop-small" if settings.components == "explain" and baseline else settings.components


def describe_pieces(summary: Mapping[str, Any]) -> str:
    """How many pieces a hull has, and what became of others, from its summary."""
    kept, found, dropped = (summary[f"components{of}"] for of in ("", "_found", "_dropped"))
    said = "in one piece" if found == 1 else f"{kept} of {found} separate pieces kept"
    return f"{said} ({dropped})" if dropped else said


def _say_dropped(sizes: np.ndarray, keep: np.ndarray, policy: str, min_fraction: float) -> str:
    if keep.all():
        return ""
    why = {
        "explain": "those kept cover the masks without them",
        "drop-small": f"none has {min_fraction:g} of the largest one's volume",
        "largest": "only the largest is kept",
    }[policy]
    share = sizes[~keep].sum() / sizes[keep].sum()
    count = int(np.count_nonzero(~keep))
    return f"{count} dropped, together {share:.2g} times the volume kept: {why}"


def _visible_region(settings: HullSettings, cameras: Cameras, search: Search) -> Region | None:
    rule, views = search.rule, search.rule.views
    if settings.kind == "released-go" or (settings.kind == "visdom" and rule.least_visible > 1):
        return find_region(cameras, search)
    start = KeepRule.of(replace(settings, kind="visdom"), views).least_visible
    # With K = 1 the views close nothing: the box is that of the usual K.
    start = 3 if start == 1 else start
    for k in range(min(start, views), 0, -1):
        region = find_region(cameras, search._replace(rule=rule._replace(least_visible=k)))
        if region is not None:
            return region
    return None


def _clip_to_ball(occupancy: np.ndarray, grid: Grid, centre: np.ndarray, radius: float) -> None:
    """Clears, in place, the voxels whose centres lie outside the ball."""
    if radius <= 0:
        raise ConfigError("the ball of unit-sphere has no extent", where="VisibleDomain.sphere_radius")
    x, y, z = ((grid.centres(a) - centre[a]) ** 2 for a in range(3))
    yz = y[:, None] + z
    for i in range(len(x)):
        occupancy[i] &= yz <= radius**2 - x[i]
