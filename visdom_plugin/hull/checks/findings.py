"""Findings of a check: one per fault."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from visdom_plugin.errors import list_some

Sure = Literal["certain", "likely", "possible"]
KINDS = (
    "size", "empty", "full", "border", "speckled", "inverted", "duplicate", "axes", "order", "turned", "swapped",
    "scale", "principal", "centres", "view", "disagreement", "clustered", "covisibility", "few",
)  # fmt: skip
"""What findings are called; each is an anchor of `visdom_plugin.errors.PAGE`."""


class Finding(NamedTuple):
    """One thing that is wrong, or worth knowing."""

    kind: str
    """Machine-readable name, one of `KINDS`; of masks that may be none, mask-grey."""
    what: str
    """A sentence with the number behind it."""
    views: tuple[int, ...]
    """Positions of the views concerned; empty when it is the whole capture."""
    sure: Sure
    evidence: float
    """The number behind `sure`; what it measures is said in `what`."""
    todo: str
    """What to do about it."""
    alternatives: tuple[str, ...] = ()
    """Kinds of other causes that would explain it equally well."""
    note: bool = False
    """True for what is worth knowing but harms nothing: it does not make a capture faulty."""
    turned_deg: float | None = None
    """Of one view: by how many degrees its camera seems to be turned, where turning it back makes it fit."""


class Name(list[str]):
    """Names of views for sentences."""

    @classmethod
    def numbered(cls, count: int) -> Name:
        """ "view 0", "view 1", ..., for views without names."""
        return cls(f"view {i}" for i in range(count))

    def all_of(self, views: Sequence[int], most: int = 6) -> str:
        """ "a", "a and b", "a, b and c", "a, b, ... (9 in all)"."""
        names = [self[i] for i in views]
        if len(names) > most:
            return list_some(names, most)
        return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]

    def masks_of(self, views: Sequence[int], one: str, many: str) -> str:
        """ "the mask of a" or "the masks of a and b", with the verb that fits."""
        return (
            f"the mask of {self[views[0]]} {one}"
            if len(views) == 1
            else (f"the masks of {self.all_of(views)} {many}")
        )


def spell_range(values: Sequence[float], spelled: str) -> str:
    """ "3" or "3 to 12", from the least to the largest, each formatted as `spelled`."""
    low, high = (format(x, spelled) for x in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
