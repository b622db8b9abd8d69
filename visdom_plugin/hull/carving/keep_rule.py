"""The keep rule: which pairs of vote counts leave a voxel in the hull. Exact, in integers."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from visdom_plugin.hull.settings import HullSettings


class KeepRule(NamedTuple):
    """Keep when the votes agree and enough views see the voxel."""

    views: int
    """N, the number of views that vote."""
    least_visible: int
    """K, the fewest views that must see the voxel; 1 for the traditional hull; 0 for `least_occupied`."""
    agreement: Fraction | None
    """n_occ >= agreement * n_vis, a fraction in (0, 1]; None when another test takes its place."""
    max_misses: int | None = None
    """n_vis - n_occ <= max_misses, in place of the agreement."""
    least_occupied: int | None = None
    """n_occ >= this, in place of both: GaussianObject's released rule, with no count of visibility."""

    @classmethod
    def of(cls, settings: HullSettings, views: int) -> KeepRule:
        """The rule that settings ask for with a number of views; `k="auto"` must have been resolved."""
        if settings.kind == "released-go":
            return cls(views, 0, None, least_occupied=max(views - 1, 1))
        k = max(views - 1, 1) if settings.k == "n-1" else settings.k
        if k == "auto":
            raise ValueError("k is to be chosen first")
        agreement = None if settings.max_misses is not None else as_fraction(settings.agreement)
        return cls(views, k if settings.kind == "visdom" else 1, agreement, settings.max_misses)

    def of_known(self) -> KeepRule:
        """The rule for votes in which pixels at which nothing is known count as misses.

        Such a pixel counts as a hit in the rule itself, so that it carves nothing. What no view knows to be
        object, or only one where K asks for several, is then kept by them alone.
        """
        least = self.least_visible if self.least_occupied is None else self.least_occupied
        return KeepRule(self.views, 0, None, least_occupied=min(max(least, 1), 2))

    def keeps(self, visible: int, occupied: int) -> bool:
        """Whether a voxel seen by `visible` views and inside the mask of `occupied` of them stays."""
        if self.least_occupied is not None:
            return occupied >= self.least_occupied
        if visible < self.least_visible:
            return False
        if self.max_misses is not None:
            return visible - occupied <= self.max_misses
        assert self.agreement is not None
        return occupied * self.agreement.denominator >= self.agreement.numerator * visible

    def table(self) -> np.ndarray:
        """(N + 1, N + 1) uint8 array: entry [n_vis, n_occ] is 1 where the voxel stays."""
        table = np.zeros((self.views + 1, self.views + 1), np.uint8)
        for visible in range(self.views + 1):
            for occupied in range(visible + 1):
                table[visible, occupied] = self.keeps(visible, occupied)
        return table

    def meaning(self) -> str:
        """The rule in words, at this number of views."""
        n = self.views
        if self.least_occupied is not None:
            return f"inside at least {self.least_occupied} of {n} masks; not seeing a voxel counts as a miss"
        misses = [
            next(m for m in range(v, -1, -1) if self.keeps(v, v - m))
            for v in range(self.least_visible, n + 1)
        ]
        said = f"max_misses {self.max_misses}"
        if self.agreement is not None:
            said = f"the agreement: at least {float(self.agreement):g} of them"
        if not misses:
            return f"{said} among at least {self.least_visible} views, but there are only {n}"
        but = "" if misses[-1] == 0 else " but one" if misses[-1] == 1 else f" but {misses[-1]}"
        return f"inside the masks of all{but} of the views that see it ({said}; {n} views in all)"


def describe_rule(summary: Mapping[str, Any]) -> str:
    """A hull's rule in words: K and what it means, and the agreement.

    Args:
        summary: of the hull.
    """
    seen = f"seen by at least {summary['k']} views (K = {summary['k']}), "
    return seen * (summary["kind"] == "visdom") + summary["agreement_means"]


def as_fraction(agreement: float) -> Fraction:
    """The decimal as it is written: 0.95 means 19/20, not the nearest binary number."""
    return Fraction(str(agreement))
