"""Findings in words: what causes, contradictions and coverage are called, and what to do about them."""

from __future__ import annotations

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.hull.checks.causes.fault_hypotheses import QUIET_PX, Suspicion
from visdom_plugin.hull.checks.causes.pose_conventions import PoseFaults
from visdom_plugin.hull.checks.causes.turned_view import Turn
from visdom_plugin.hull.checks.covisibility import LEAST_K, LOST, USUAL_K, Advice, measure_spread
from visdom_plugin.hull.checks.findings import Finding, Name, Sure
from visdom_plugin.hull.outlines.distance_fields import OBJECT_PX, Outlines
from visdom_plugin.hull.outlines.silhouette_consistency import Coherence
from visdom_plugin.hull.wording import wording

DISAGREE_PX = 0.1
"""Contradiction of masks and cameras beyond which they are said to disagree."""
_CLUSTERED_DEGREES = 60.0
"""Views within this angle leave a hull more than 1.7 times as deep as the object."""
_DEAR = 0.2
"""Share of a mask that no other view shows: up to here a note, beyond it a finding."""
_TODO = {
    "scale": "scale the intrinsics with the images: a photograph resized by s has s times the focal length and "
    "principal point",
    "order": "check how images, masks and poses are matched: sort them by the same key",
    "turned": "turn photographs and masks back: the poses were estimated from them the other way round, as a "
    "viewer shows them that follows EXIF's orientation",
    "swapped": "exchange them back, photographs and masks, or their poses",
    "view": "look at this view's mask and pose, or leave it out",
}


def say_too_few(count: int) -> Finding:
    """Fewer than two views; `count` of them have a mask."""
    return Finding(
        "few",
        f"there is {'one view' if count else 'no view'} with a mask: nothing says how deep the object is, and no "
        "hull can be carved",
        tuple(range(count)),
        "certain",
        count,
        wording().more_views.format(count=3),
    )


def say_one_point(count: int) -> Finding:
    """All `count` cameras stand at one point."""
    return Finding(
        "centres",
        f"all {count} cameras stand at one point, from which nothing can be told of depth",
        (),
        "certain",
        float(count),
        "give each pose its camera's position; on a turntable, world-to-camera matrices taken for their inverses "
        "look like this: invert them",
    )


def share_of_length(px: float) -> str:
    """Pixels of masks that are OBJECT_PX long, as a percentage of the object's length."""
    return f"{px / OBJECT_PX:.2%}"


def say_cause(
    cause: Suspicion, usable: np.ndarray, names: Name, poses: PoseFaults, turn: Turn | None
) -> Finding:
    """What a suspected cause explains.

    Args:
        usable: positions of the views that the cause counts.
        poses: what to do about each pose convention.
        turn: of a single view, the turn that makes it fit.
    """
    views = tuple(int(usable[v]) for v in cause.views)
    after = f"{share_of_length(cause.after)} of the object's length in the mean"
    before = share_of_length(cause.before)
    gain = f"undone, masks and cameras miss each other by {after} in place of {before}"
    if cause.kind == "view":
        gain = f"without it the other views miss each other by {after}, with it by {before}"
        what = f"{names[views[0]]} does not fit the others"
        if cause.rivals:
            rivals = tuple(int(usable[v]) for v in cause.rivals)
            views = tuple(sorted((*views, *rivals)))
            what = f"one of {names.all_of(views)} does not fit the others"
        what += f" ({cause.detail})" if cause.detail else ""
    elif cause.kind == "swapped":
        what = f"photographs and masks of {names.all_of(views)} are exchanged"
    else:
        what = cause.detail
    for kind, others, detail in cause.others[:3]:
        other = names.all_of([int(usable[v]) for v in others]) + ": " if others else ""
        what += f"; or {other}{detail}" if kind != "swapped" else f"; or {other}exchanged"
    if cause.before <= QUIET_PX:
        gain = f"as given, no view rules out anything for another; undone they do, and miss each other by {after}"
    ratio = min(cause.after / max(cause.before, 1e-9), 1.0)
    sure: Sure = "certain" if cause.before > DISAGREE_PX and ratio < 0.1 else "likely"
    sure = "possible" if cause.rivals or cause.others else sure
    todo = dict(poses)[cause.detail] if cause.kind == "axes" else _TODO[cause.kind]
    alternatives = tuple(sorted({kind for kind, _, _ in cause.others}))
    said = Finding(cause.kind, f"{what}: {gain}", views, sure, 1 - ratio, todo, alternatives)
    if turn is None:
        return said
    what = f"{said.what}; its camera seems turned by about {turn.degrees:.1f} degrees (a small move of it, or of "
    what += f"its mask, looks the same): turned back, all miss each other by {share_of_length(turn.after)}"
    todo = f"look whether its mask lies on its photograph; where it does, {wording().refine.format(view=views[0])}"
    return said._replace(what=what, todo=f"{todo}; or leave the view out", turned_deg=round(turn.degrees, 2))


def say_disagreement(fit: Coherence, views: np.ndarray, names: Name) -> Finding:
    """Masks and cameras contradict each other, and no single cause explains it."""
    worst = np.argsort(-np.nan_to_num(fit.contradicted))[:3]
    named = tuple(int(views[w]) for w in worst)
    share = float(np.nan_to_num(fit.contradicted)[worst[0]])
    return Finding(
        "disagreement",
        f"masks and cameras contradict each other by {share_of_length(fit.score)} of the object's length in the "
        f"mean, and no single cause explains it; worst in {names.all_of(named)}",
        named,
        "likely" if share > 0.1 else "possible",
        share,
        f"{wording().sheet}; check poses and intrinsics, then the masks of these views",
    )


def say_covisibility(advice: Advice, views: np.ndarray, asked: int | None, names: Name) -> list[Finding]:
    """What the views show too little in common for."""
    if not advice.covered:
        return []
    wanted, found = USUAL_K if asked is None else asked, []
    if advice.k < min(wanted, max(len(views), LEAST_K) if asked is None else wanted):
        if advice.k + 1 not in advice.covered:
            what, lost = f"K = {wanted} is more than the {len(views)} usable views", np.ones(len(views))
        else:
            what = f"too little is seen in common for K = {wanted}: {advice.why.partition(': ')[2]}"
            lost = advice.covered[LEAST_K] - advice.covered[advice.k + 1]
        set_k = wording().set_k.format(k=advice.k)
        todo = f"use K = {advice.k} ({set_k}), or views that show more of the object in common"
        found.append(_seen(what, views, lost, todo, note=asked is None))
    alone = advice.covered[1] - advice.covered[LEAST_K]
    if alone.max() > LOST:
        shown = [f"{lost:.1%} of {names[v]}" for v, lost in zip(views, alone, strict=True) if lost > LOST]
        what = f"no other view shows a part of the mask, which every K from {LEAST_K} on loses: {', '.join(shown)}"
        todo = "add a view that shows this part, too; K = 1 would keep it, but opens the hull to the cameras"
        found.append(_seen(what, views, alone, todo, note=float(alone.max()) <= _DEAR))
    return found


def _seen(what: str, views: np.ndarray, lost: np.ndarray, todo: str, note: bool) -> Finding:
    """A finding on what the views see in common; `lost` (N,) is the share that each view's mask loses."""
    if 2 * (lost > LOST).sum() > len(lost):
        todo += (
            "; where they do show it, poses or intrinsics are wrong: with too long a focal length views miss "
        )
        todo += "each other"
    concerned = tuple(int(v) for v in views[lost > LOST])
    return Finding("covisibility", what, concerned, "certain", float(lost.max()), todo, note=note)


def say_clustered(outlines: Outlines, fit: Coherence, cameras: Cameras) -> list[Finding]:
    """Views from similar directions."""
    middle = look_at_point(cameras.to(dtype=torch.float64)).cpu().numpy() if fit.ball is None else fit.ball[0]
    spread = measure_spread(outlines.centres, middle)
    if spread.degrees >= _CLUSTERED_DEGREES:
        return []
    return [
        Finding(
            "clustered",
            f"all views look from within {spread.degrees:.0f} degrees of each other (opposite sides count as "
            f"one): the hull may be {spread.stretch:.1f} times as deep as the object",
            (),
            "certain" if spread.degrees < 0.67 * _CLUSTERED_DEGREES else "likely",
            spread.degrees,
            "add views from the sides; the visible domain gains little from views of similar directions",
        )
    ]
