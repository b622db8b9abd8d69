"""One camera among others, turned by a little until its mask fits theirs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from visdom_plugin.hull.outlines.distance_fields import Outlines, is_known
from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence
from visdom_plugin.hull.refine.poses import RefineConfig, rotations, solve
from visdom_plugin.hull.refine.rays import find_points, outline_pixels, pack

_CONFIG = RefineConfig(turn_deg=5.0)
"""One camera is told so well by the others that what it is given as matters little."""
_RAYS, _CYCLES, _VIEWS = 128, 5, 12
"""Of each view; views beyond so many add seconds and nothing else."""
_FAR = 0.25
"""A start that would turn the camera by more, in radians, is no small correction."""


def turn_to_fit(outlines: Outlines, view: int) -> Outlines | None:
    """Turns one camera, its place kept, until the masks agree best.

    Tried from the pose as given and, because a turn of many pixels ends in front of it, from one that looks at the
    object that the other views show.

    Args:
        outlines: three views or more, all but the one with poses that are right.

    Returns:
        All views with the one turned; None where no point agrees.
    """
    others = np.delete(np.arange(len(outlines)), view)
    others = others[np.arange(min(_VIEWS - 1, len(others))) * len(others) // min(_VIEWS - 1, len(others))]
    few = outlines.keep(np.array([view, *others]))
    starts = [few] if (aimed := _aim(few)) is None else [few, aimed]
    tried = [f for s in starts if (f := solve(s, _CONFIG, [0], rays=_RAYS, cycles=_CYCLES)) is not None]
    if not tried:
        return None
    best = min(tried, key=lambda f: measure_coherence(f, _RAYS, power=False).score)
    turned = outlines.rotations.copy()
    turned[view] = best.rotations[0]
    return replace(outlines, rotations=turned)


def _aim(outlines: Outlines) -> Outlines | None:
    """The first camera turned so that its mask lies where the others' outlines appear in it; None for nowhere."""
    rest, field = outlines.keep(np.arange(len(outlines)) > 0), outlines.fields[0]
    ball = measure_coherence(rest, _RAYS, power=False).ball
    inside = np.argwhere((field < 0) & is_known(field))
    if ball is None or not len(inside):
        return None
    rays, _ = find_points(pack(rest), *outline_pixels(rest, _RAYS), ball)
    if not len(rays.view):
        return None
    inverse = np.linalg.inv(rest.intrinsics)
    lines = np.einsum("pij,pj->pi", inverse[rays.view], np.c_[rays.uv, np.ones(len(rays.uv))])
    lines = np.einsum("pij,pj->pi", rest.rotations[rays.view], lines)
    points = rest.centres[rays.view] + rays.depth[:, None] * lines / np.linalg.norm(lines, axis=1)[:, None]
    seen = (points - outlines.centres[0]) @ outlines.rotations[0]
    if (seen[:, 2] <= 0).any():
        return None
    seen = seen[:, :2] / seen[:, 2:]
    K = outlines.intrinsics[0]
    rows, columns = (inside[:, k] + 0.5 for k in (0, 1))
    mask = np.c_[(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]]
    there, here = (np.array([*(p.min(0) + p.max(0)) / 2, 1.0]) for p in (seen, mask))
    there, here = there / np.linalg.norm(there), here / np.linalg.norm(here)
    axis = np.cross(here, there)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9 or sine > _FAR:
        return None
    turned = outlines.rotations.copy()
    turned[0] = turned[0] @ rotations(axis[None] * (math.asin(sine) / sine))[0]
    return replace(outlines, rotations=turned)
