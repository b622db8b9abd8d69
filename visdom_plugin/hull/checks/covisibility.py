"""What the views see in common: co-visibility per K, the K it advises, and how far apart the views look from."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from visdom_plugin.hull.checks.distance_fields import Outlines
from visdom_plugin.hull.checks.findings import Name
from visdom_plugin.hull.checks.silhouette_consistency import (
    Coherence,
    choose_pixels,
    march_rays,
    measure_coherence,
)

USUAL_K = 3
LOST = 0.02
"""A K may leave this share of a mask's rays without support beyond what K = 1 leaves."""
_TOLERANCE_PX = 1.0
_RAYS, _MOST_RAYS = 256, 4608


class Advice(NamedTuple):
    """The K that the views allow."""

    k: int
    covered: dict[int, np.ndarray]
    """For each K, (N,) the share of each mask's rays with a point that K views see and no view rules out."""
    why: str
    """One sentence."""


def advise_k(
    outlines: Outlines, names: Name | None = None, fit: Coherence | None = None, wanted: int = USUAL_K
) -> Advice:
    """The largest K up to the wanted one whose hull still covers every mask, within LOST of K = 1.

    Args:
        outlines: the views, at least one.
        fit: from `measure_coherence`, when it is at hand.
    """
    most = min(wanted, len(outlines))
    if len(outlines) < 2:
        return Advice(1, {1: np.ones(len(outlines))}, "there is only one view")
    rays = int(np.clip(_MOST_RAYS // len(outlines), 32, _RAYS))
    fit = measure_coherence(outlines, rays, power=False) if fit is None else fit
    if fit.ball is None:
        return Advice(most, {}, "the masks agree nowhere, so nothing can be said of K")
    view, uv = choose_pixels(outlines, rays)
    covered = {}
    for k in range(1, most + 1):
        found = march_rays(outlines, view, uv, least=k - 1, ball=fit.ball)
        hit = found.whole <= _TOLERANCE_PX
        shares = [hit[view == i].mean() if (view == i).any() else 1.0 for i in range(len(outlines))]
        covered[k] = np.array(shares)
    chosen = next(k for k in range(most, 0, -1) if (covered[k] >= covered[1] - LOST).all())
    names = Name([f"view {i}" for i in range(len(outlines))]) if names is None else names
    return Advice(chosen, covered, _say(chosen, most, covered, names))


def _say(chosen: int, most: int, covered: dict[int, np.ndarray], names: Name) -> str:
    if chosen == most:
        worst = int(np.argmin(covered[chosen]))
        return (
            f"K = {chosen}: every mask keeps its object (least {names[worst]}, {covered[chosen][worst]:.1%} of "
            f"its rays have a point that {chosen} views see)"
        )
    lost = covered[1] - covered[chosen + 1]
    worst = int(np.argmax(lost))
    return (
        f"K = {chosen}: K = {chosen + 1} would lose {lost[worst]:.1%} of the mask of {names[worst]}, which fewer "
        f"than {chosen + 1} views see"
    )


class Spread(NamedTuple):
    """From how far apart the views look."""

    degrees: float
    """Largest angle between two lines of sight, opposite sides counting as one: 0 to 90."""
    stretch: float
    """How many times deeper than wide a round object's hull may become."""


def measure_spread(centres: np.ndarray, middle: np.ndarray) -> Spread:
    """Spread of the directions from cameras (N, 3) to the object's middle (3,).

    Two views an angle a apart (a <= 90 degrees) cut a round object to a rhombus 1 / tan(a / 2) times as deep as
    wide; a view from the opposite side has the same silhouette and cuts nothing new.
    """
    away = middle - centres
    length = np.linalg.norm(away, axis=1, keepdims=True)
    lines = away / np.maximum(length, 1e-12)
    cosine = np.abs(lines @ lines.T).min() if len(lines) else 1.0
    degrees = math.degrees(math.acos(min(float(cosine), 1.0)))
    return Spread(degrees, 1 / max(math.tan(math.radians(degrees) / 2), 1e-6))
