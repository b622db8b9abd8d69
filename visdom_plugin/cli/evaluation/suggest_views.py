"""Which views of a large capture to train on: those that look from as different directions as can be.

Photographs are spread over training by their order, which says nothing of where they look from. Directions need no
pixels; only masks of the views that are picked are looked at, and views that are cut off are passed over.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from visdom_plugin.scene import Scene

_ROUNDS, _MOST = 6, 400
_BETTER_DEGREES = 5.0
_LEAST_SPACING = 1e-9
_UNFIT = ("border", "empty", "full", "size", "speckled", "inverted")
"""Findings on single masks for which a view is passed over."""


class Suggestion(NamedTuple):
    """How the views that train by default do beside the best."""

    looked_at: int
    """Views that train by default."""
    free: int
    """Views that could train."""
    degrees: float
    """Angle between the two of the default's directions that are nearest to each other."""
    best: tuple[str, ...]
    """Names of the views suggested; empty where the default ones are as good."""
    best_degrees: float
    passed_over: tuple[str, ...]
    """Views of the default whose mask is cut off or otherwise unfit."""
    stems_tell: bool = False
    """Whether file names without folder and ending tell all views apart."""

    def describe(self) -> str:
        """Sentences for the user, and on a line of its own the option that names better views."""
        said = f"{self.looked_at} of {self.free} views that could train were looked at, spread by order of their "
        said += (
            f"names (--views {self.free} checks all); the nearest two look from {self.degrees:.0f} degrees "
        )
        said += "apart"
        if not self.best:
            return f"{said}, and hardly any choice does better."
        if self.passed_over:
            cut = ", ".join(self.passed_over)
            said += f". {cut} {'is' if len(self.passed_over) == 1 else 'are'} cut off or badly masked"
        instead = " without it" * (len(self.passed_over) == 1) or " without them" * bool(self.passed_over)
        stems = [PurePosixPath(name).stem for name in self.best]
        listed = ",".join(stems if self.stems_tell else self.best)
        return f"{said}. Better{instead} ({self.best_degrees:.0f} degrees):\n--train-list {listed}"


def suggest_views(
    scene: Scene, unfit: set[str], folder: Path, *, seed: int, downscale: float, views: int, **reading: Any
) -> Suggestion | None:
    """Compares the default views with the best; None where lists or index files choose, or none are left over.

    Args:
        scene: as it was read, without test views.
        unfit: views of it whose masks are cut off or otherwise unfit.
        folder: of the scene; with `views`, `downscale`, `seed` and `reading` as it was read.
    """
    from datamodules.recognise import load_free_views
    from visdom_plugin.cli.scenes import load_options, open_scene
    from visdom_plugin.geometry.cameras import look_at_point

    free = load_free_views(folder, views=views, downscale=downscale, **load_options(**reading))
    names = [] if free is None else list(free.names)
    count = len(scene.train)
    if (
        free is None
        or count < 2
        or not count < len(names) <= _MOST
        or not set(scene.train.names) <= set(names)
    ):
        return None
    away = (free.cameras.centres - look_at_point(free.cameras)).cpu().numpy()
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    default = [names.index(name) for name in scene.train.names]
    known = {names.index(name): name in unfit for name in scene.train.names}
    for _ in range(_ROUNDS):
        left = np.array([i for i in range(len(names)) if not known.get(i, False)])
        if len(left) <= count:
            return None
        best = left[pick_apart(directions[left], count)].tolist()
        new = [i for i in best if i not in known]
        if new:
            listed = ",".join(names[i] for i in new)
            asked = {**reading, "train_list": listed, "missing_masks": "colour"}
            found = open_scene(
                folder, views=len(new), downscale=downscale, seed=seed, fill=False, test=False, **asked
            )
            bad = find_unfit(found)
            known |= {i: names[i] in bad for i in new}
        if not any(known[i] for i in best):
            break
    else:
        return None
    given, reached = (_spacing(directions[list(chosen)]) for chosen in (default, best))
    passed = tuple(names[i] for i in default if known[i])
    better = bool(passed) or reached > given + _BETTER_DEGREES
    chosen = tuple(names[i] for i in sorted(best)) if better else ()
    stems_tell = len({PurePosixPath(name).stem for name in names}) == len(names)
    return Suggestion(count, len(names), given, chosen, reached, passed, stems_tell)


def find_unfit(scene: Scene) -> set[str]:
    """Training views without a mask, or whose mask is cut off or otherwise unfit."""
    from visdom_plugin.cli.scenes import carving_views
    from visdom_plugin.hull.checks.check import check

    views, masks = carving_views(scene.train)
    unmasked = set(scene.train.names) - set(views.names)
    if not len(views):
        return unmasked
    found = check(views.cameras, masks, names=views.names, ignore=views.ignore, brief=True)
    return unmasked | unfit_views([*found.findings, *found.notes], views.names)


def unfit_views(findings: list[Any], names: Any) -> set[str]:
    """Names of the views whose mask some findings call unfit."""
    return {names[i] for f in findings if f.kind in _UNFIT for i in f.views}


def pick_apart(directions: np.ndarray, count: int) -> list[int]:
    """Positions of `count` unit vectors (N, 3) whose nearest two are far apart.

    From every start the vector farthest from all that are picked is added; then each in turn is exchanged while
    that helps. The result need not be the best there is.
    """
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    best: list[int] = []
    reached = -1.0
    for start in range(len(directions)):
        chosen = [start]
        while len(chosen) < count:
            nearest = angles[chosen].min(0)
            nearest[chosen] = -1
            chosen.append(int(nearest.argmax()))
        for _ in range(2 * count):
            before = _nearest(angles, chosen)
            for place in range(count):
                rest = chosen[:place] + chosen[place + 1 :]
                nearest = angles[rest].min(0) if rest else angles[0]
                nearest = np.where(np.isin(np.arange(len(angles)), rest), -1, nearest)
                chosen[place] = int(nearest.argmax())
            if _nearest(angles, chosen) <= before + _LEAST_SPACING:
                break
        if (found := _nearest(angles, chosen)) > reached:
            best, reached = list(chosen), found
    return best


def _spacing(directions: np.ndarray) -> float:
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    return _nearest(angles, list(range(len(directions))))


def _nearest(angles: np.ndarray, chosen: list[int]) -> float:
    return float((angles[np.ix_(chosen, chosen)] + 1e3 * np.eye(len(chosen))).min())
