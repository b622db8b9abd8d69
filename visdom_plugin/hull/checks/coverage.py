"""What is wrong with a hull: how well it covers the masks, which view disagrees, what each K would leave."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.bounds import grid_in
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.octree import block_carve, sum_areas
from visdom_plugin.hull.carving.votes import Grid, Silhouettes, gather_silhouettes
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.hull.settings import HullSettings

log = logging.getLogger(__name__)

COARSE = 64
"""Voxels per side of the trial hulls."""
_INVERTED_BORDER = 0.5


class Coverage(NamedTuple):
    """How a hull's silhouette meets one view's mask."""

    covered: float
    """Share of the mask's pixels that the hull covers; 1 for an empty mask."""
    inside: float
    """Share of the hull's silhouette that lies on the mask; 1 where the hull is not seen."""
    seen: bool = True
    """Whether the view sees the hull at all."""


class ViewReport(NamedTuple):
    """One view's part in a hull."""

    covered: float
    inside: float
    border: float
    """Share of the image's border pixels that are foreground; above 0 the object may be cut off."""
    removes: float
    """Share of the hull's volume that this view's mask alone takes away: how much it disagrees with the others."""


class Diagnosis(NamedTuple):
    """What `diagnose` found."""

    views: list[ViewReport]
    voxels_per_k: dict[int, int]
    """Voxels that the rule would keep for each K, in the hull's own box at 64 voxels per side, before culling."""
    findings: list[str]
    """Sentences for the user, most serious first."""


def border_share(mask: np.ndarray) -> float:
    """Share of a mask's (H, W) border pixels that are foreground."""
    ring = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
    return float(ring.astype(bool).mean())


def look_inverted(mask: np.ndarray) -> bool:
    """Whether most of the image's border is foreground, as in a mask that marks the background."""
    return border_share(mask) > _INVERTED_BORDER


def measure_coverage(hull: Hull, cameras: Cameras, masks: Sequence) -> list[Coverage]:
    """Coverage of each mask, by casting a ray through every pixel.

    Args:
        cameras: (N,) cameras.
        masks: N tensors or arrays (H, W), True on the object.
    """
    result = []
    for view, mask in enumerate(masks):
        _, seen = depth_and_silhouette(hull, cameras[view].to("cpu"))
        seen, mask = seen.numpy(), np.asarray(mask.cpu() if hasattr(mask, "cpu") else mask).astype(bool)
        both, of_mask, of_hull = (int(np.count_nonzero(x)) for x in (seen & mask, mask, seen))
        result.append(
            Coverage(both / of_mask if of_mask else 1.0, both / of_hull if of_hull else 1.0, of_hull > 0)
        )
    return result


def diagnose(
    domain: HullSettings, hull: Hull, cameras: Cameras, masks: Sequence, names: Sequence[str] | None = None
) -> Diagnosis:
    """Looks for what keeps a hull from being a good one.

    Args:
        domain: what the hull was carved with.
        cameras, masks: the views it was carved from.
        names: the views' names, for the findings.
    """
    silhouettes = gather_silhouettes(cameras, masks, domain.dilate_px)
    names = [f"view {i}" for i in range(len(masks))] if names is None else list(names)
    grid = grid_in(hull.extent, COARSE)
    rule = KeepRule.of(replace(domain, k=hull.summary.get("k", 1) or 1), len(silhouettes))
    removed = leave_one_out(silhouettes, grid, rule)
    coverage = measure_coverage(hull, cameras, [silhouettes.mask(i) for i in range(len(silhouettes))])
    views = [
        ViewReport(*coverage[i][:2], border_share(silhouettes.mask(i)), removed[i])
        for i in range(len(silhouettes))
    ]
    per_k = votes_per_k(silhouettes, grid, domain)
    return Diagnosis(views, per_k, _findings(views, names, per_k, rule, hull))


def leave_one_out(silhouettes: Silhouettes, grid: Grid, rule: KeepRule) -> list[float]:
    """For each view, the share of the others' volume in `grid` that its mask takes away, in [0, 1].

    Space that only exists through this view (K) is not counted.
    """
    whole = block_carve(silhouettes, grid, rule)
    shares = []
    for view in range(len(silhouettes)):
        if len(silhouettes) == 1:
            return [0.0]
        least = min(rule.least_visible, len(silhouettes) - 1)
        occupied = None if rule.least_occupied is None else max(rule.least_occupied - 1, 1)
        fewer = rule._replace(views=len(silhouettes) - 1, least_visible=least, least_occupied=occupied)
        others = block_carve(silhouettes.without(view), grid, fewer)
        total = int(np.count_nonzero(others))
        shares.append(int(np.count_nonzero(others & ~whole)) / total if total else 0.0)
    return shares


def votes_per_k(silhouettes: Silhouettes, grid: Grid, domain: HullSettings) -> dict[int, int]:
    """Voxels of `grid` that pass the agreement and are seen by at least 1, 2, ..., N views."""
    counts, areas = {}, sum_areas(silhouettes)
    for k in range(1, len(silhouettes) + 1):
        rule = KeepRule.of(replace(domain, k=k, kind="visdom"), len(silhouettes))
        counts[k] = int(np.count_nonzero(block_carve(silhouettes, grid, rule, areas)))
    return counts


def choose_k(cameras: Cameras, silhouettes: Silhouettes) -> int:
    """The K that `advise_k` advises: the largest of 3, 2, 1 whose hull covers every mask as K = 1 does."""
    # These need OpenCV, which carving with a given K does not.
    from visdom_plugin.hull.checks.covisibility import advise_k
    from visdom_plugin.hull.checks.distance_fields import draw_outlines

    advice = advise_k(draw_outlines(cameras, silhouettes))
    log.info("k=auto takes %s", advice.why)
    return advice.k


def _findings(views, names, per_k, rule: KeepRule, hull: Hull) -> list[str]:
    said = []
    for name, view in zip(names, views, strict=True):
        if view.covered < 0.9:
            said.append(
                f"{name}: the hull covers only {view.covered:.1%} of its mask: a pose or another mask is off"
            )
    worst = max(range(len(views)), key=lambda i: views[i].removes)
    typical = float(np.median([v.removes for v in views]))
    if views[worst].removes > 0.5 and views[worst].removes > 2 * typical:
        said.append(
            f"{names[worst]}: its mask alone removes {views[worst].removes:.0%} of what the other views leave "
            f"(typically {typical:.0%})"
        )
    for name, view in zip(names, views, strict=True):
        if view.border > 0:
            said.append(f"{name}: the mask touches the border of the image, the object may be cut off")
    k = rule.least_visible
    if k > 1 and per_k.get(k, 0) < 0.9 * per_k[1]:
        share = 1 - per_k.get(k, 0) / per_k[1]
        said.append(f"K = {k} removes {share:.0%} of the volume that one view would be enough for")
    if not hull.summary.get("bounds_closed", True):
        said.append("the views leave the hull open; it is cut off at its box")
    return said
