"""Fault hypotheses: each suspected cause of a misfit is undone, and the fit measured again.

A suspicion is believed when undoing it lowers the residuals of all rays to a quarter or less, and more than any
other does. Leaving a view out always lowers them a little, so a cause that keeps every view goes first when it
does as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from visdom_plugin.hull.checks.causes.pose_conventions import IN_MEMORY, PoseFaults
from visdom_plugin.hull.outlines.distance_fields import Outlines
from visdom_plugin.hull.outlines.silhouette_consistency import Coherence, measure_coherence

QUIET_PX = 0.015
"""Mean residual (in pixels of the fields, an object is 128 long) below which nothing is looked for: sound captures
of four to nine views stay below 0.03, most below 0.002."""
_RATIO = 0.25
_FLOOR_PX = 0.004
_SCALES = (1 / 8, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4, 8)
_MOST_RAYS, _TRIAL_RAYS, _BRIEF_RAYS = 1536, 512, 768
_ALL_PAIRS = 9
_MOST_ROUNDS = 3
_POWER, _LEAST_POWER_PX, _TIE = 0.8, 0.5, 0.9
_SIMPLE = ("axes", "scale", "turned", "swapped", "order")
_GAIN = 1.05
_LEAST_FOR_TWO = 6
_FAR_OFF = 0.2


class Suspicion(NamedTuple):
    """A cause and how well it explains."""

    kind: str
    views: tuple[int, ...]
    detail: str
    """For the sentence: what was undone."""
    before: float
    """Mean residual as given, pixels of the fields."""
    after: float
    """Mean residual with the cause undone."""
    rivals: tuple[int, ...] = ()
    """Other views that would explain it as well, when a single view is to blame."""
    others: tuple[tuple[str, tuple[int, ...], str], ...] = ()
    """Other causes (kind, views, detail) that fit equally well."""
    power: float = 0.0
    """`Coherence.power` with the detail of a single view undone."""


Change = Callable[[Outlines], Outlines]


class _Trial(NamedTuple):
    kind: str
    views: tuple[int, ...]
    detail: str
    change: Change


_FLIP = np.diag([1.0, -1.0, -1.0])


def find_causes(
    outlines: Outlines, *, brief: bool = False, poses: PoseFaults = IN_MEMORY
) -> tuple[list[Suspicion], Coherence, np.ndarray]:
    """Looks for causes until the rest fits together.

    Args:
        outlines: two views or more, none empty.
        brief: try only wrong axes and single views, with few rays.
        poses: what to say of wrong poses.

    Returns:
        The causes, most serious first; the coherence of what is left; and which views are left (N,) bool. When
        something is wrong that no single cause explains, the last coherence's score stays high.
    """
    left, found = np.ones(len(outlines), bool), []
    rays = int(np.clip((_BRIEF_RAYS if brief else _MOST_RAYS) // len(outlines), 16, 256))
    fit = measure_coherence(outlines, rays)
    for _ in range(_MOST_ROUNDS):
        # Views that share nothing agree on everything, and that is suspicious too.
        if left.sum() < 2 or (fit.score <= QUIET_PX and (fit.power >= _LEAST_POWER_PX or left.sum() < 3)):
            break
        index = np.flatnonzero(left)
        cause, changed = _best_cause(outlines.keep(index), fit, rays, brief, poses)
        causes = _two_views(outlines.keep(index), fit, rays) if cause is None else [cause]
        for c in causes:
            concerned, rivals = (tuple(int(index[i]) for i in views) for views in (c.views, c.rivals))
            found.append(c._replace(views=concerned, rivals=rivals))
            if c.kind == "view":
                left[list(concerned)] = False
            else:
                outlines = _put_back(outlines, index, changed)
        if not causes or causes[0].rivals or left.sum() < 2:
            break
        fit = measure_coherence(outlines.keep(left), rays)
        if len(causes) > 1:
            break
    return found, fit, left


def _best_cause(
    outlines: Outlines, fit: Coherence, rays: int, brief: bool, poses: PoseFaults
) -> tuple[Suspicion | None, Outlines]:
    """The cause that explains most, or None, and the outlines with it undone."""
    count, before = len(outlines), fit.score
    silent = before <= QUIET_PX
    enough = QUIET_PX if silent else _RATIO * before
    alone = np.array([fit.score_without(i) for i in range(count)]) if count >= 3 else np.full(count, np.inf)
    culprit = int(np.argmin(alone))
    tried = []
    for trial in _whole_trials(count, alone, fit, brief, poses):
        changed = trial.change(outlines)
        # Where masks are silent the principal points must speak: any longer lens makes views more selective.
        if silent and not (_off_centre(outlines) > _FAR_OFF and _off_centre(changed) < _FAR_OFF / 2):
            continue
        after = _fits(changed, enough, rays)
        if after is not None:
            tried.append((trial, changed, after))
    alone_fits = alone[culprit] <= enough
    if tried:
        # Of those that fit about equally well, the ones that the masks leave least room for; the simplest first.
        least = min(t[2].score for t in tried)
        tried = [t for t in tried if t[2].score <= 2 * least + _FLOOR_PX]
        most = max(t[2].power for t in tried)
        tried = sorted(
            (t for t in tried if t[2].power >= _TIE * most), key=lambda t: _SIMPLE.index(t[0].kind)
        )
        best, changed, after = tried[0]
        others = tuple(t[0][:3] for t in tried[1:] if t[0].kind != best.kind or best.kind == "swapped")
        fits = (
            silent
            or not alone_fits
            or (
                after.score <= max(alone[culprit], _FLOOR_PX)
                and after.power >= _POWER * fit.power_without(culprit)
            )
        )
        if fits and after.power > _LEAST_POWER_PX:
            return Suspicion(best.kind, best.views, best.detail, before, after.score, (), others), changed
    if silent or not alone_fits:
        return None, outlines
    suspects = _closest({i: float(alone[i]) for i in range(count)})
    if len(suspects) > 1:
        # The object's place was found with the wrong view in it; found anew without each, it tells them apart.
        rest = {i: outlines.keep(np.arange(count) != i) for i in suspects}
        suspects = _closest({i: measure_coherence(rest[i], rays, power=False).score for i in suspects})
    culprit, *rivals = suspects
    detail, power = ("", 0.0) if rivals or brief else _explain_view(outlines, culprit, rays, fit, poses)
    misses = float(alone[culprit])
    return Suspicion("view", (culprit,), detail, before, misses, tuple(rivals), power=power), outlines


def _fits(changed: Outlines, enough: float, rays: int) -> Coherence | None:
    """How well changed views fit together, where that is well enough; few rays do to rule a change out."""
    fewer = int(np.clip(_TRIAL_RAYS // len(changed), 8, 64))
    if measure_coherence(changed, fewer, 2.0, power=False).score > 2 * enough:
        return None
    after = measure_coherence(changed, rays)
    return after if after.score <= enough else None


def _closest(scores: dict[int, float]) -> list[int]:
    """The views without which the others fit best, or about as well as best; the best first."""
    best = min(scores.values())
    close = [i for i in scores if scores[i] <= max(2 * best, best + _FLOOR_PX)]
    return sorted(close, key=lambda i: scores[i])


def _off_centre(outlines: Outlines) -> float:
    """Median distance of the principal points from the images' centres, in image sizes."""
    sizes = np.array([f.shape[::-1] for f in outlines.fields])
    return float(np.median(np.abs(outlines.intrinsics[:, :2, 2] / sizes - 0.5).max(1)))


def _two_views(outlines: Outlines, fit: Coherence, rays: int) -> list[Suspicion]:
    """Two views without which the others fit; none when there is no such pair, or several."""
    count = len(outlines)
    if count < _LEAST_FOR_TWO or fit.score <= QUIET_PX:
        return []
    scores = {}
    for first in np.argsort([fit.score_without(i) for i in range(count)])[:4].tolist():
        rest = np.delete(np.arange(count), first)
        without = measure_coherence(outlines.keep(rest), rays, power=False)
        for k, second in enumerate(rest.tolist()):
            scores[min(first, second), max(first, second)] = without.score_without(k)
    (views, after), (_, next_best) = sorted(scores.items(), key=lambda item: item[1])[:2]
    clear = after <= _RATIO * fit.score and 2 * after + _FLOOR_PX < next_best
    return [Suspicion("view", (v,), "", fit.score, after) for v in views] if clear else []


def _whole_trials(
    count: int, alone: np.ndarray, fit: Coherence, brief: bool, poses: PoseFaults
) -> Iterator[_Trial]:
    """Causes that keep every view."""
    everyone: tuple[int, ...] = ()
    for fault, change in zip(poses, _AXES, strict=True):
        yield _Trial("axes", everyone, fault.what, change)
    if brief:
        return
    for scale in _SCALES:
        for whole in (False, True):
            what = "the focal lengths and principal points" if whole else "the focal lengths"
            yield _Trial("scale", everyone, f"{what} are {1 / scale:.3g} times what they should be",
                         partial(_scaled, factor=scale, whole=whole))  # fmt: skip
    for what, turn in _TURNS:
        yield _Trial("turned", everyone, f"photographs and masks are {what}", partial(_fields, change=turn))
    if count >= 3:
        for shift in (-1, 1):
            order = np.roll(np.arange(count), shift)
            way = "one before" if shift == 1 else "one after"
            yield _Trial(
                "order",
                everyone,
                f"each view has the mask of the {way} it",
                partial(_ordered, order=order),
            )
        order = np.arange(count)[::-1]
        yield _Trial("order", everyone, "the masks are in reverse order", partial(_ordered, order=order))
    suspects = np.arange(count)
    if count > _ALL_PAIRS:
        blame = np.argsort(alone)[:5], np.argsort(-np.nan_to_num(fit.whole))[:3]
        suspects = np.unique(np.concatenate(blame))
    for a, b in combinations(suspects.tolist() if count >= 3 else [], 2):
        order = np.arange(count)
        order[[a, b]] = b, a
        yield _Trial("swapped", (a, b), "their masks fit when exchanged", partial(_ordered, order=order))


def _explain_view(
    outlines: Outlines, view: int, rays: int, fit: Coherence, poses: PoseFaults
) -> tuple[str, float]:
    """The change that would mend one view, in words, empty for none; and the power that all views have then."""
    trials = [(fault.what, change) for fault, change in zip(poses, _AXES, strict=True)]
    trials += [
        (
            f"its focal length is {1 / s:.3g} times what it should be",
            partial(_scaled, factor=s, whole=False),
        )
        for s in (1 / 4, 1 / 2, 2, 4)
    ]
    turns = (*_TURNS, ("inverted", lambda f: -f))
    trials += [(f"its mask is {what}", partial(_fields, change=turn)) for what, turn in turns]
    best, said, index = _GAIN * fit.power_without(view), "", np.array([view])
    enough = max(2 * fit.score_without(view), _FLOOR_PX)
    for detail, change in trials:
        after = _fits(_put_back(outlines, index, change(outlines.keep(index))), enough, rays)
        # A view that is mended narrows the hull down; one that merely falls silent does not.
        if after is not None and after.power > best and np.isfinite(after.whole[view]):
            best, said = after.power, detail
    return said, best if said else 0.0


def _turned(outlines: Outlines, right: np.ndarray) -> Outlines:
    return replace(outlines, rotations=outlines.rotations @ right)


def _inverse(outlines: Outlines) -> Outlines:
    rotations = outlines.rotations.transpose(0, 2, 1)
    return replace(
        outlines,
        rotations=np.ascontiguousarray(rotations),
        centres=-(rotations @ outlines.centres[:, :, None])[:, :, 0],
    )


_TURNS: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("turned by 180 degrees", lambda f: f[::-1, ::-1]),
    ("mirrored left to right", lambda f: f[:, ::-1]),
    ("upside down", lambda f: f[::-1]),
)
"""Turns that leave an image's size as it is, those of EXIF's tags 3, 2 and 4, and what undoes each."""
_AXES: tuple[Change, ...] = (
    lambda o: _turned(o, _FLIP),
    _inverse,
    lambda o: _turned(_inverse(o), _FLIP),
    lambda o: _inverse(_turned(_inverse(o), _FLIP)),
)
"""What undoes each of `PoseFaults`, in their order."""


def _scaled(outlines: Outlines, factor: float, whole: bool) -> Outlines:
    K = outlines.intrinsics.copy()
    K[:, 0, 0] *= factor
    K[:, 1, 1] *= factor
    if whole:
        K[:, :2, 2] *= factor
    return replace(outlines, intrinsics=K)


def _ordered(outlines: Outlines, order: np.ndarray) -> Outlines:
    return outlines.with_fields([outlines.fields[i] for i in order])


def _fields(outlines: Outlines, change: Callable[[np.ndarray], np.ndarray]) -> Outlines:
    return replace(outlines, fields=tuple(np.ascontiguousarray(change(f)) for f in outlines.fields))


def _put_back(outlines: Outlines, index: np.ndarray, changed: Outlines) -> Outlines:
    rotations, centres, K = (a.copy() for a in (outlines.rotations, outlines.centres, outlines.intrinsics))
    rotations[index], centres[index], K[index] = changed.rotations, changed.centres, changed.intrinsics
    fields = list(outlines.fields)
    for i, field in zip(index, changed.fields, strict=True):
        fields[i] = field
    return Outlines(rotations, centres, K, tuple(fields))
