"""Distances along a ray, warped so that equal steps are short near the camera and long far from it.

The power ladder of Zip-NeRF (supplement): P(x, p) = |p-1|/p ((x/|p-1| + 1)^p - 1), here for p other than 0 and 1.
Normalised distances s run from 0 at near to 1 at far.
"""

from __future__ import annotations

from torch import Tensor

POWER = -1.5
PREMULTIPLIER = 2.0
CURVE_POWER = -0.25
CURVE_PREMULTIPLIER = 10_000.0


def power_ladder(x: Tensor, power: float, premultiplier: float = 1.0) -> Tensor:
    """P(premultiplier x, power) of x (...) >= 0; below |power - 1| / |power| for negative powers."""
    scale = abs(power - 1)
    return ((x * (premultiplier / scale) + 1) ** power - 1) * (scale / power)


def distances_of(
    s: Tensor, near: Tensor, far: Tensor, power: float = POWER, premultiplier: float = PREMULTIPLIER
) -> Tensor:
    """t (..., S) in [near, far] (..., 1) of normalised distances s (..., S) in [0, 1]. power 1 is linear.

    Interpolates (t/|p-1| + 1)^p itself, which keeps its precision where s is near 1 and far is huge.
    """
    if power == 1:
        return near * (1 - s) + far * s
    factor = factor_of(power, premultiplier)
    between = (near * factor + 1) ** power * (1 - s) + (far * factor + 1) ** power * s
    t = (between ** (1 / power) - 1) / factor
    return t.maximum(near).minimum(far)


def factor_of(power: float, premultiplier: float = PREMULTIPLIER) -> float:
    """What `distances_of` multiplies distances by; 1 where the power is."""
    return 1.0 if power == 1 else premultiplier / abs(power - 1)


def curve_distances(t: Tensor) -> Tensor:
    """Distances (...) >= 0 as Zip-NeRF's distortion loss measures them (p = -0.25, times 10,000)."""
    return power_ladder(t, CURVE_POWER, CURVE_PREMULTIPLIER)
