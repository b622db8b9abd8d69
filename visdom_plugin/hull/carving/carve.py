"""From cameras and masks to a Hull, as a VisibleDomain says."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.bounds import Region, cube_around, find_region, grid_in
from visdom_plugin.hull.carving.culling import explaining_pieces
from visdom_plugin.hull.carving.keep_rule import KeepRule, as_fraction
from visdom_plugin.hull.carving.octree import block_carve, sum_areas
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, dense_carve, gather_silhouettes
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.grid.components import choose_pieces, erase_pieces, find_pieces
from visdom_plugin.hull.hull import Hull, occupied_box

log = logging.getLogger(__name__)

_LOOSE, _TIGHTENINGS = 0.6, 3
"""Share of the grid's side below which what is kept gets a grid of its own, and how often."""


def keep_rule(domain: VisibleDomain, views: int) -> KeepRule:
    """The rule of a domain for a number of views; `k="auto"` must have been resolved."""
    if domain.kind == "released-go":
        return KeepRule(views, 0, None, least_occupied=max(views - 1, 1))
    k = max(views - 1, 1) if domain.k == "n-1" else domain.k
    least = k if domain.kind == "visdom" else 1
    agreement = None if domain.max_misses is not None else as_fraction(domain.agreement)
    return KeepRule(views, least, agreement, domain.max_misses)


def carve(domain: VisibleDomain, cameras: Cameras, masks: Sequence) -> Hull:
    """See `VisibleDomain.carve`."""
    from visdom_plugin.hull.checks.coverage import choose_k, look_inverted
    from visdom_plugin.hull.checks.explain_failure import explain_empty
    from visdom_plugin.hull.checks.misfit import find_misfit

    log.info("carving the hull (the first time on a machine its kernels are compiled: 10 to 30 s)")
    silhouettes = gather_silhouettes(cameras, masks, domain.dilate_px)
    asked = domain.k
    if domain.k == "auto" and domain.kind != "released-go":
        domain = replace(domain, k=choose_k(domain, cameras, silhouettes))
    device = getattr(masks[0], "device", "cpu")
    hull = carve_silhouettes(domain, cameras, silhouettes, device=device)
    if hull is None:
        raise explain_empty(domain, cameras, silhouettes)
    hull.summary["k_asked"] = asked
    misfit = find_misfit(domain, cameras, silhouettes, hull)
    if misfit is not None:
        log.warning(misfit)
    elif not hull.summary["bounds_closed"]:
        log.warning(
            "the views leave the hull open: it is cut off at %s .. %s; more views from other sides, a larger k or "
            "explicit bounds would close it",
            *np.round(hull.bounds, 4).tolist(),
        )
    inverted = [i for i in range(len(silhouettes)) if look_inverted(silhouettes.mask(i))]
    if 2 * len(inverted) > len(silhouettes):
        log.warning(
            "%d of %d masks are foreground along most of the image's border: they may mark the background; "
            "`visdom-hull --diagnose` tells more",
            len(inverted),
            len(silhouettes),
        )
    dropped = hull.summary["components_dropped"]
    log.info(
        "hull: %s, %d views; %s; %d of %s voxels of %.4g, %d of %d pieces%s, %.2f s",
        domain.kind, len(silhouettes), hull.summary["agreement_means"], hull.voxels,
        "x".join(map(str, hull.shape)), hull.voxel_size, hull.summary["components"],
        hull.summary["components_found"], dropped and f" ({dropped})",
        hull.summary["seconds"] + hull.summary["bounds_seconds"],
    )  # fmt: skip
    return hull


def carve_silhouettes(
    domain: VisibleDomain, cameras: Cameras, silhouettes: Silhouettes, *, device="cpu", effort: float = 1.0
) -> Hull | None:
    """The hull, or None when nothing is left; `effort` as in `find_region`."""
    rule = keep_rule(domain, len(silhouettes))
    started = time.perf_counter()
    areas = sum_areas(silhouettes)
    summed = time.perf_counter()
    placed = _place(domain, cameras, silhouettes, rule, areas, effort)
    if placed is None:
        return None
    grid, ball, closed = placed
    located = time.perf_counter()
    policy = _policy(domain, rule)
    found = _carve_grid(domain, policy, silhouettes, rule, areas, grid, ball, device)
    # Cells tell less than voxels: where the search kept what the voxels then lost, the grid shrinks to the rest.
    for _ in range(_TIGHTENINGS if policy == "explain" and domain.bounds is None else 0):
        if found is None:
            break
        occupancy, pieces, keep = found
        box = occupied_box(occupancy)
        if (box[1] - box[0]).max() > _LOOSE * domain.resolution:
            break
        margin = np.array([[-1], [1]]) * (2 + 0.05 * (box[1] - box[0]).max())
        grid = cube_around(grid.lower + (box + margin) * grid.voxel, domain.resolution)
        found = _carve_grid(domain, policy, silhouettes, rule, areas, grid, ball, device)
    if found is None:
        return None
    occupancy, pieces, keep = found
    ended = time.perf_counter()
    summary = {
        "kind": domain.kind,
        "views": len(silhouettes),
        "k": rule.least_visible,
        "agreement": None if rule.agreement is None else domain.agreement,
        "max_misses": rule.max_misses,
        "agreement_means": rule.meaning(),
        "resolution": domain.resolution,
        "components": int(keep.sum()),
        "components_found": len(keep),
        "components_rule": policy,
        "components_dropped": _say_dropped(pieces.sizes, keep, policy, domain.min_component_fraction),
        "voxels_dropped": int(pieces.sizes[~keep].sum()),
        "bounds_closed": closed,
        "dilate_px": domain.dilate_px,
        # Votes to grid, and the search for the bounds, which explicit bounds save.
        "seconds": round(ended - located + summed - started, 4),
        "bounds_seconds": round(located - summed, 4),
    }
    if ball is not None:
        summary |= {"sphere_centre": [float(x) for x in ball[0]], "sphere_radius": float(ball[1])}
    return Hull(occupancy, grid.bounds, summary)


def _carve_grid(
    domain: VisibleDomain, policy: str, silhouettes, rule: KeepRule, areas, grid: Grid, ball, device
):
    """Occupancy after culling, its pieces before and which of them stayed; None for an empty grid."""
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
        keep = choose_pieces(pieces.sizes, policy, domain.min_component_fraction)
    if not keep.all():
        erase_pieces(occupancy, pieces, keep)
    return occupancy, pieces, keep


def _place(domain: VisibleDomain, cameras, silhouettes, rule: KeepRule, areas, effort: float):
    """Grid, ball (centre, radius) or None, and whether the views close the region; None for no region."""
    needs_ball = domain.kind == "unit-sphere"
    given = None if domain.bounds is None else np.array(domain.bounds, np.float64)
    ball_given = domain.sphere_centre is not None and domain.sphere_radius is not None
    region = None
    if given is None or (needs_ball and not ball_given):
        region = _visible_region(domain, cameras, silhouettes, rule, areas, effort)
        if region is None:
            return None
    ball = None
    if needs_ball:
        box = None if region is None else region.bounds
        centre = box.mean(0) if domain.sphere_centre is None else np.array(domain.sphere_centre, np.float64)
        radius = domain.sphere_radius
        ball = centre, float(np.linalg.norm(box[1] - box[0]) / 2) if radius is None else float(radius)
    closed = region is None or region.closed
    if given is not None:
        return grid_in(given, domain.resolution), ball, True
    box = region.bounds
    if ball is not None:
        box = np.stack([ball[0] - ball[1], ball[0] + ball[1]])
    elif _one_view_is_enough(domain, rule):
        centres = cameras.centres.double().cpu().numpy()
        box = np.stack([np.minimum(box[0], centres.min(0)), np.maximum(box[1], centres.max(0))])
    return cube_around(box, domain.resolution), ball, closed


def _one_view_is_enough(domain: VisibleDomain, rule: KeepRule) -> bool:
    return domain.kind == "traditional" or (domain.kind == "visdom" and rule.least_visible == 1)


def _policy(domain: VisibleDomain, rule: KeepRule) -> str:
    """What decides about the grid's pieces."""
    baseline = domain.kind == "unit-sphere" or _one_view_is_enough(domain, rule)
    return "drop-small" if domain.components == "explain" and baseline else domain.components


def _say_dropped(sizes: np.ndarray, keep: np.ndarray, policy: str, min_fraction: float) -> str:
    if keep.all():
        return ""
    why = {
        "explain": "they explain no foreground that what is kept does not explain",
        "drop-small": f"below {min_fraction:g} of the largest piece's volume",
        "largest": "not the largest",
    }[policy]
    share = sizes[~keep].sum() / sizes[keep].sum()
    return f"dropped {np.count_nonzero(~keep)}, {share:.2g} of the volume kept: {why}"


def _visible_region(domain, cameras, silhouettes, rule: KeepRule, areas, effort: float) -> Region | None:
    def find(rule: KeepRule) -> Region | None:
        fraction = 0.5 if domain.components == "largest" else domain.min_component_fraction
        return find_region(
            cameras, silhouettes, rule, domain.components, fraction, areas=areas, effort=effort
        )

    if domain.kind == "released-go" or (domain.kind == "visdom" and rule.least_visible > 1):
        return find(rule)
    views = len(silhouettes)
    start = keep_rule(replace(domain, kind="visdom"), views).least_visible
    # With K = 1 the views close nothing: the box is that of the usual K.
    start = 3 if start == 1 else start
    for k in range(min(start, views), 0, -1):
        region = find(rule._replace(least_visible=k))
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
