"""Explanations of carves that fail: a hull that is empty, or one that leaves most of its masks uncovered.

What is wrong with the data is asked of the check; a box or a ball that misses the hull is tried here. A hull
carved with wrong poses is seldom empty: views meet by chance, on whatever scale.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import torch

from visdom_plugin.errors import EmptyHullError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.carve import carve_silhouettes
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Silhouettes
from visdom_plugin.hull.checks.causes.intrinsics import describe_suspicion, find_other_unit
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.coverage import POOR_COVERAGE, measure_coverage
from visdom_plugin.hull.checks.covisibility import LEAST_K, USUAL_K
from visdom_plugin.hull.checks.degenerate import count_cameras_inside, describe_speck
from visdom_plugin.hull.checks.findings import Finding, Name
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.outlines.distance_fields import draw_outlines
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.hull.wording import wording

log = logging.getLogger(__name__)

_COARSE = 64
"""Voxels per side of a trial hull."""
_CONVINCING = 0.9
"""Mean share of the masks that a trial hull must cover."""
_SHOWN = 3
_HARMLESS = ("border", "clustered", "few", "full")
"""Findings that empty no hull."""
_AFTER_SETTINGS = ("covisibility", "disagreement")
"""Findings that explain less than a box beside the hull does."""
_WHERE = {
    "axes": "camera poses",
    "centres": "camera poses",
    "scale": "camera intrinsics",
    "principal": "camera intrinsics",
    "covisibility": "k",
}


def explain_empty(settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes) -> EmptyHullError:
    """The error for an empty hull, with the likeliest cause where one could be established."""
    views = len(silhouettes)
    rule = KeepRule.of(settings, views)
    k = rule.least_visible
    what = f"the hull is empty: no voxel satisfies the keep rule ({rule.meaning()}, K = {k})"
    if settings.kind == "released-go":
        what = f"the hull is empty: no voxel is {rule.meaning()}"
    faults = _faults(settings, cameras, silhouettes)
    fault = next((f for f in faults if f.kind not in _AFTER_SETTINGS), None)
    if fault is None and k > views:
        only = "is only 1 view" if views == 1 else f"are only {views} views"
        fewer = min(USUAL_K, views)
        less = f", or K = {fewer} ({wording().set_k.format(k=fewer)}) or less" if views >= LEAST_K else ""
        return EmptyHullError(
            what,
            where="k",
            cause=f"K = {k} is larger than co-visibility allows: there {only}",
            todo="use more views" + less,
        )
    if fault is None:
        beside = _beside(settings, cameras, silhouettes)
        if beside is not None:
            cause, todo, setting = beside
            return EmptyHullError(what, where=setting, cause=cause, todo=todo)
        fault = next(iter(faults), None)
    if fault is None:
        return EmptyHullError(
            what, todo=f"{wording().look}, or let some views miss: {wording().allow_misses}"
        )
    return EmptyHullError(what, where=_where(fault), cause=_cause(fault), todo=_todo(fault))


def explain_one_point(settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes) -> SceneError:
    """The error for cameras that all stand at one point."""
    fault = next(f for f in _faults(settings, cameras, silhouettes) if f.kind in ("axes", "centres"))
    what = f"all {len(cameras)} cameras stand at one point, from which nothing can be told of depth"
    cause = None if fault.kind == "centres" else _cause(fault)
    return SceneError(what, where=_where(fault), cause=cause, todo=_todo(fault), topic=fault.kind)


def refuse_other_unit(cameras: Cameras, silhouettes: Silhouettes) -> None:
    """Raises SceneError where focal lengths in another unit than pixels explain the masks; where the masks do not
    decide, a warning tells of those that are odd."""
    outlines = draw_outlines(cameras, silhouettes)
    if found := find_other_unit(cameras, outlines)[0]:
        raise SceneError(_cause(found[0]), where="camera intrinsics", todo=found[0].todo, topic=found[0].kind)
    if found := find_other_unit(cameras, outlines, faint=True)[0]:
        log.warning("camera intrinsics: %s; %s", _cause(found[0]), found[0].todo)
        return
    if odd := describe_suspicion(cameras):
        log.warning("camera intrinsics: %s", odd)


def find_misfit(settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes, hull: Hull) -> str | None:
    """A sentence for the user when a hull that does not look sound leaves most of the masks uncovered, or None.

    Raises:
        SceneError: when poses of another convention explain the masks, or the hull is a mere speck.
    """
    cameras = cameras.to("cpu", dtype=torch.float64)
    covered, speck = _mean_coverage(hull, cameras, silhouettes), describe_speck(cameras, hull)
    inside = count_cameras_inside(KeepRule.of(settings, len(silhouettes)), cameras, hull)
    what = f"the hull does not explain the masks: it covers {covered:.0%} of them in the mean"
    if speck is not None:
        what = f"{speck}, and covers {covered:.0%} of the masks in the mean"
    elif inside and covered >= POOR_COVERAGE:
        what = f"the hull reaches the cameras: {inside} of {len(cameras)} stand inside it"
    log.info(
        "the hull does not look sound (it covers %.0f%% of the masks); looking for a cause", 100 * covered
    )
    fault = next(iter(_faults(settings, cameras, silhouettes)), None)
    if fault is not None and fault.kind == "axes" and fault.sure != "possible":
        raise SceneError(what, where=_where(fault), cause=_cause(fault), todo=_todo(fault), topic=fault.kind)
    if speck is not None:
        meeting = "poses or intrinsics that do not belong to these masks, so that views meet only by chance"
        raise SceneError(
            what,
            where="camera poses" if fault is None else _where(fault),
            cause=meeting if fault is None else _cause(fault),
            todo=wording().look if fault is None else _todo(fault),
            topic="disagreement" if fault is None else fault.kind,
        )
    if covered >= POOR_COVERAGE:
        cause = "none was found" if fault is None else f"{_cause(fault)}; {_todo(fault)}"
        log.info("cause: %s; the hull is used as it is", cause)
        return None
    if fault is not None:
        return f"{what}; {_cause(fault)}; {_todo(fault)}"
    few = f", or too little is seen by K = {settings.k} views" if settings.kind == "visdom" else ""
    return f"{what}; poses, intrinsics or masks of some views are wrong{few}; {wording().look}"


def _faults(settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes) -> list[Finding]:
    """Findings of the check that can empty a hull, most serious first, one of each kind."""
    masks, ignore = _known(silhouettes)
    rule = KeepRule.of(settings, len(silhouettes))
    asked = rule.least_visible if settings.kind == "visdom" else None
    found = check(cameras, masks, ignore=ignore, k=asked)
    groups: dict[str, list[Finding]] = {}
    for f in found.findings:
        # Equal masks that fit the others are those of a symmetric object.
        if f.kind not in _HARMLESS and not (f.kind == "duplicate" and set(f.views) <= set(found.usable)):
            groups.setdefault(f.kind, []).append(f)
    return [_join(group) for group in groups.values()]


def _join(group: list[Finding]) -> Finding:
    """Findings of one kind as one, as sure as the first."""
    what = "; ".join(f.what for f in group[:_SHOWN]) + f"; and {len(group) - _SHOWN} more" * (
        len(group) > _SHOWN
    )
    return group[0]._replace(what=what, views=tuple(dict.fromkeys(v for f in group for v in f.views)))


def _where(fault: Finding) -> str | None:
    if not fault.views or fault.kind in _WHERE:
        return _WHERE.get(fault.kind)
    return Name.numbered(max(fault.views) + 1).all_of(fault.views)


def _cause(fault: Finding) -> str:
    return fault.what if fault.sure == "certain" else f"{fault.what} ({fault.sure})"


def _todo(fault: Finding) -> str:
    if fault.kind != "axes":
        return fault.todo
    # A reader turns a file's poses into those of Cameras: which of the two is at fault is not seen here.
    return wording().poses or fault.todo


def _known(silhouettes: Silhouettes) -> tuple[list[np.ndarray], list[np.ndarray | None]]:
    """Masks of what is known to be object, and the pixels at which nothing is known."""
    known, views = silhouettes.demanding(), range(len(silhouettes))
    return [known.mask(i) for i in views], [silhouettes.unknown_in(i) for i in views]


def _mean_coverage(hull: Hull, cameras: Cameras, silhouettes: Silhouettes) -> float:
    masks, ignore = _known(silhouettes)
    seen = measure_coverage(hull, cameras, masks, ignore)
    shares = [c.covered for c, mask in zip(seen, masks, strict=True) if mask.any()]
    return float(np.mean(shares)) if shares else 1.0


def _beside(
    settings: HullSettings, cameras: Cameras, silhouettes: Silhouettes
) -> tuple[str, str, str] | None:
    """Cause, what to do and the setting, when a hull that explains the masks lies beside the given box or ball."""
    ball = settings.kind == "unit-sphere" and bool(settings.sphere_centre or settings.sphere_radius)
    if settings.bounds is None and not ball:
        return None
    free = replace(settings, bounds=None, resolution=_COARSE)
    if settings.bounds is None:
        free = replace(free, sphere_centre=None, sphere_radius=None)
    hull = carve_silhouettes(free, cameras, silhouettes)
    if hull is None or _mean_coverage(hull, cameras.to("cpu"), silhouettes) < _CONVINCING:
        return None
    if settings.bounds is None:
        return "the given ball misses the hull", "drop sphere_centre and sphere_radius", "sphere_centre"
    (low, high), given = hull.extent, np.array(settings.bounds)
    where = f"{low.round(4).tolist()} .. {high.round(4).tolist()}"
    if (given[0] < high).all() and (low < given[1]).all():
        return f"no voxel's centre lies in the hull, which spans {where}", "raise the resolution", "bounds"
    return f"the given bounds miss the hull, which lies in {where}", "drop the bounds", "bounds"
