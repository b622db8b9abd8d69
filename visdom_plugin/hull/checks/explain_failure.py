"""Why a hull came out empty: each suspicion is tried at low resolution, and named only when the trial succeeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from visdom_plugin.errors import EmptyHullError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.carve import carve_silhouettes
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Silhouettes
from visdom_plugin.hull.checks.coverage import COARSE, look_inverted, measure_coverage
from visdom_plugin.hull.settings import HullSettings

COMMAND = "visdom-hull DIR --diagnose"
_CONVINCING = 0.9
"""Mean share of the masks that a trial hull must cover."""
_EFFORT = 0.1
"""Of the search for a trial hull's box: wrong suspicions leave many cells undecided and should fail soon."""


def explain_empty(domain: HullSettings, cameras: Cameras, silhouettes: Silhouettes) -> EmptyHullError:
    """The error for an empty hull, with the likeliest cause if one of these could be established.

    In this order: empty masks; K above the number of views; inverted masks; explicit bounds or a ball beside the
    hull; poses in another convention; K above what the views see in common; a single view that disagrees.
    """
    views = len(silhouettes)
    rule = KeepRule.of(domain, views)
    what = f"the hull is empty: no voxel satisfies the keep rule ({rule.meaning()}, K = {rule.least_visible})"
    if domain.kind == "released-go":
        what = f"the hull is empty: no voxel is {rule.meaning()}"
    for suspect in (
        _empty_masks,
        _too_few_views,
        _inverted,
        _beside,
        find_convention,
        _covisibility,
        _single_view,
    ):
        found = suspect(domain, cameras, silhouettes)
        if found is not None:
            cause, todo, where = found
            return EmptyHullError(what, where=where, cause=cause, todo=todo)
    return EmptyHullError(
        what,
        todo=f"look at each view's part in it: {COMMAND}, or let some views miss: --max-misses 1",
    )


def _list(views: Sequence[int]) -> str:
    shown = ", ".join(map(str, views[:6])) + (", ..." if len(views) > 6 else "")
    return f"view {shown}" if len(views) == 1 else f"views {shown}"


def ways_to_set_k(k: int) -> str:
    """How K is set, wherever the hull is asked for."""
    return f"K = {k} (visdom-hull -k {k}, visdom-train --method.hull.k {k}, VisibleDomain(k={k}))"


def _try(domain: HullSettings, cameras: Cameras, silhouettes: Silhouettes) -> float:
    """Mean share that a coarse hull covers of the masks of the views that see it, 0 without one."""
    hull = carve_silhouettes(replace(domain, resolution=COARSE), cameras, silhouettes, effort=_EFFORT)
    if hull is None:
        return 0.0
    masks = [silhouettes.mask(i) for i in range(len(silhouettes))]
    shares = [c.covered for c in measure_coverage(hull, cameras, masks) if c.seen]
    return float(np.mean(shares)) if shares else 0.0


def _empty_masks(domain, cameras, silhouettes):
    empty = [i for i in range(len(silhouettes)) if not silhouettes.mask(i).any()]
    if not empty:
        return None
    whose = "all masks are" if len(empty) == len(silhouettes) else f"the masks of {_list(empty)} are"
    if len(empty) == 1 and len(silhouettes) > 1:
        whose = f"the mask of {_list(empty)} is"
    todo = "check the mask files and the threshold that reads them, or leave these views out"
    return f"{whose} empty: no foreground pixel", todo, _list(empty)


def _too_few_views(domain, cameras, silhouettes):
    k = KeepRule.of(domain, len(silhouettes)).least_visible
    if k <= len(silhouettes):
        return None
    cause = f"K = {k} is larger than co-visibility allows: there are only {len(silhouettes)} views"
    return cause, f"use more views, or {ways_to_set_k(min(3, len(silhouettes)))} or less", None


def _beside(domain, cameras, silhouettes):
    if domain.bounds is not None:
        free = replace(domain, bounds=None)
        hull = carve_silhouettes(replace(free, resolution=COARSE), cameras, silhouettes, effort=_EFFORT)
        if hull is not None and _try(free, cameras, silhouettes) >= _CONVINCING:
            low, high = np.round(hull.extent, 4).tolist()
            return (
                f"the given bounds miss the hull, which lies in {low} .. {high}",
                "drop the bounds",
                "bounds",
            )
    if domain.kind == "unit-sphere" and (domain.sphere_centre or domain.sphere_radius):
        free = replace(domain, sphere_centre=None, sphere_radius=None)
        if _try(free, cameras, silhouettes) >= _CONVINCING:
            return "the given ball misses the hull", "drop sphere_centre and sphere_radius", "sphere_centre"
    return None


def _inverted(domain, cameras, silhouettes):
    flagged = [i for i in range(len(silhouettes)) if look_inverted(silhouettes.mask(i))]
    if not flagged:
        return None
    pixels = silhouettes.pixels.copy()
    turned = replace(silhouettes, pixels=pixels)
    for i in flagged:
        turned.mask(i)[:] ^= 1
    if _try(replace(domain, bounds=None), cameras, turned) < _CONVINCING:
        return None
    whose = "the masks" if len(flagged) == len(silhouettes) else f"the masks of {_list(flagged)}"
    cause = f"{whose} are inverted: they mark the background; turned over, the hull is not empty"
    return cause, "invert them: True (white) on the object", _list(flagged)


def find_convention(domain: HullSettings, cameras: Cameras, silhouettes: Silhouettes):
    """Cause, what to do and where, when the poses read in another convention explain the masks; or None."""
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    motion = cameras.world_from_camera.double().cpu()
    inverse = cameras.camera_from_world.double().cpu()
    gl, w2c = 'convention="opengl"', "world-to-camera matrices"
    trials = [
        (motion @ flip, f"the poses have OpenGL axes (y up, z backward): pass {gl} to Cameras.from_matrices"),
        (inverse, f"the poses are {w2c}: pass their inverses, world_from_camera"),
        (inverse @ flip, f"the poses are {w2c} with OpenGL axes: pass their inverses and {gl}"),
    ]
    scores = []
    for matrix, _ in trials:
        other = Cameras(cameras.intrinsics.double().cpu(), matrix, cameras.width.cpu(), cameras.height.cpu())
        projections = other.intrinsics.numpy() @ other.camera_from_world[:, :3].numpy()
        scores.append(
            _try(domain, other, replace(silhouettes, projections=np.ascontiguousarray(projections)))
        )
    best = int(np.argmax(scores))
    if scores[best] < _CONVINCING:
        return None
    cause, _, todo = trials[best][1].partition(": ")
    # A reader turns a file's poses into those of Cameras: which of the two is at fault is not seen here.
    cause = f"as they reach the hull, {cause}; read so, the hull covers {scores[best]:.0%} of the masks"
    todo += "; of a scene on disk, `visdom-check DIR` tells what its file holds wrongly"
    return cause, todo, "camera poses"


def _covisibility(domain, cameras, silhouettes):
    if domain.kind != "visdom":
        return None
    k = KeepRule.of(domain, len(silhouettes)).least_visible
    for fewer in range(k - 1, 0, -1):
        if _try(replace(domain, k=fewer), cameras, silhouettes) >= _CONVINCING:
            cause = f"K = {k} is larger than co-visibility: too little is seen by more than {fewer}"
            return cause, f"use {ways_to_set_k(fewer)}, or views that see more of the object in common", "k"
    return None


def _single_view(domain, cameras, silhouettes):
    if len(silhouettes) < 3:
        return None
    index = np.arange(len(silhouettes))
    k = KeepRule.of(domain, len(silhouettes)).least_visible
    scores = []
    for view in index:
        rest = torch.from_numpy(index[index != view])
        less = replace(domain, k=max(1, min(k, len(silhouettes) - 1)))
        scores.append(_try(less, cameras[rest], silhouettes.without(view)))
    best = int(np.argmax(scores))
    if scores[best] < _CONVINCING or sum(s >= _CONVINCING for s in scores) > 1:
        return None
    cause = f"view {best} disagrees with all others: without it the hull is not empty"
    return cause, f"check the pose and the mask of view {best}, or leave it out", f"view {best}"
