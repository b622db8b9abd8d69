"""Co-visibility: what K views see in common, the K to take, and how far apart the views look from."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from visdom_plugin.hull.checks.findings import Name
from visdom_plugin.hull.outlines.distance_fields import Outlines
from visdom_plugin.hull.outlines.silhouette_consistency import (
    Coherence,
    choose_pixels,
    march_rays,
    measure_coherence,
)

USUAL_K, LEAST_K = 3, 2
"""K = 1 is never advised: what one view alone sees is closed by no other, and its hull reaches the cameras."""
LOST = 0.02
"""A K may leave this share of a mask's rays without support beyond what LEAST_K leaves."""
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
    """The largest K up to the wanted one whose hull covers every mask within LOST of what LEAST_K covers.

    Foreground that one view alone shows is lost at every K from LEAST_K on, so it speaks for none of them; what is
    lost is said.

    Args:
        outlines: the views, at least one.
        fit: from `measure_coherence`, when it is at hand.
    """
    most = max(min(wanted, len(outlines)), LEAST_K)
    if len(outlines) < LEAST_K:
        return Advice(LEAST_K, {}, f"there is only one view, and no hull is closed with fewer than {LEAST_K}")
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
    chosen = next(k for k in range(most, 1, -1) if (covered[k] >= covered[LEAST_K] - LOST).all())
    return Advice(chosen, covered, _say(chosen, most, covered, names or Name.numbered(len(outlines))))


def _say(chosen: int, most: int, covered: dict[int, np.ndarray], names: Name) -> str:
    lost = covered[1] - covered[chosen]
    worst = int(np.argmax(lost))
    cost = ""
    if lost[worst] > LOST:
        cost = f"{lost[worst]:.1%} of the mask of {names[worst]} is lost, which fewer than {chosen} views see"
    if chosen < most:
        more = covered[chosen] - covered[chosen + 1]
        first = int(np.argmax(more))
        said = (
            f"K = {chosen + 1} would lose {more[first]:.1%} of the mask of {names[first]}, which fewer than "
        )
        return f"K = {chosen}: {said}{chosen + 1} views see" + (f"; {cost} already" if cost else "")
    if cost:
        return f"K = {chosen}: {cost}; K = 1 would keep it, but opens the hull to the cameras"
    least = int(np.argmin(covered[chosen]))
    return (
        f"K = {chosen}: every mask keeps its object (least {names[least]}, {covered[chosen][least]:.1%} of "
        f"its rays have a point that {chosen} views see)"
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
