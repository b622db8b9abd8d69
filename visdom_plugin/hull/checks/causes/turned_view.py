"""The angle by which the camera of a single view that does not fit seems to be turned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.hull.checks.causes.fault_hypotheses import Suspicion
from visdom_plugin.hull.outlines.distance_fields import Outlines
from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence
from visdom_plugin.hull.refine.one_view import turn_to_fit
from visdom_plugin.hull.refine.poses import LEAST_VIEWS

_MOST_DEG = 8.0
_SLACK_PX, _RATIO = 0.001, 0.01
"""What a turn may leave beyond what the other views miss each other by: the more of these, the second as a part of
the misfit as given."""
_RAYS = 1536
_GAIN = 1.05
"""So many times better than another change of the view a turn must narrow the hull down to be believed instead."""


class Turn(NamedTuple):
    """How one view is mended."""

    degrees: float
    after: float
    """Mean residual of all views with the one turned back, pixels of the fields."""


def measure_turn(outlines: Outlines, cause: Suspicion) -> Turn | None:
    """Turns the camera of the one view to blame back.

    A turn about the viewing axis of a round object, and any part of a turn that moves no outline, stays unknown.
    A mask that lies beside its object by a little looks the same, and so does a small move of the camera.

    Args:
        outlines: the views that the cause was found in, as they were given.

    Returns:
        None where something else is to blame or may be, where views are too few, and where no small turn makes
        the view fit about as well as the others fit each other.
    """
    if cause.kind != "view" or cause.rivals or cause.others or len(outlines) < LEAST_VIEWS:
        return None
    (view,) = cause.views
    turned = turn_to_fit(outlines, view)
    if turned is None:
        return None
    turn = outlines.rotations[view].T @ turned.rotations[view]
    degrees = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    fit = measure_coherence(turned, int(np.clip(_RAYS // len(outlines), 16, 256)))
    enough = cause.after + max(_SLACK_PX, _RATIO * cause.before)
    # A view that looks past the object contradicts nothing, and rules nothing out either.
    speaks = np.isfinite(fit.whole[view]) and fit.power > max(fit.power_without(view), _GAIN * cause.power)
    return Turn(degrees, fit.score) if fit.score <= enough and speaks and degrees <= _MOST_DEG else None
