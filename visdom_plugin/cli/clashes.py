"""Options that contradict each other, or that nothing would read, refused before the work starts.

Only what stands on the command line counts: a config file holds every option, and the command line wins over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from visdom_plugin.errors import ConfigError

_HULL = "--method.hull."


class _Clash(NamedTuple):
    option: str
    other: str
    """What cannot stand beside it."""
    values: tuple[str, ...]
    """Of the other, the values that it cannot stand beside; none for all."""
    why: str


_CLASHES = (
    _Clash("--agreement", "--max-misses", (), "both say how many views may miss a voxel"),
    _Clash("--bounds", "--bounds-capture-radii", (), "both say how large the grid is"),
    _Clash("--bounds-scale", "--bounds", (), "only automatic bounds are scaled"),
    _Clash("--k", "--kind", ("traditional", "unit-sphere", "released-go"), "this kind of hull has no K"),
    _Clash(
        "--min-component-fraction", "--components", ("all", "largest"), "no piece is dropped for its size"
    ),
    _Clash("--print-board", "--demo", (), "both say what is to be made"),
    _Clash("--out", "--info", (), "what a file holds is printed, and nothing is written"),
    _Clash("--fps", "--format", ("png",), "pictures have no speed"),
)


class _Need(NamedTuple):
    option: str
    other: str
    """Without which nothing reads the option."""
    values: tuple[str, ...]
    """Of the other, those that read it; none for all."""


NEEDS_OF_HULL = (
    _Need("--sphere-centre", "--kind", ("unit-sphere",)),
    _Need("--sphere-radius", "--kind", ("unit-sphere",)),
    _Need("--inside-radius", "--inside", ()),
    _Need("--photo-weight", "--inside", ()),
)
NEEDS_OF_PREPARE = (_Need("--paper", "--print-board", ()),)
NEEDS_OF_TABLE = (_Need("--slurm", "--executor", ("slurm",)),)


def refuse_clashes(words: Sequence[str]) -> None:
    """Raises ConfigError for two options of a command line of which one would win without a word."""
    given = _read(words)
    for clash in _CLASHES:
        values = given.get(clash.other, ())
        beside = set(values) & set(clash.values) if clash.values else clash.other in given
        if clash.option in given and beside:
            named = " ".join([clash.other, *values[:1]]) if clash.values else clash.other
            raise ConfigError(
                f"{clash.option} and {named} contradict each other: {clash.why}",
                todo="leave one of them out",
                topic="contradiction",
            )
    _refuse_two_numbers(given)
    _refuse_two_spellings(words)


def refuse_unread(words: Sequence[str], needs: Sequence[_Need]) -> None:
    """Raises ConfigError for an option of a command line that nothing would read."""
    given = _read(words)
    for need in needs:
        values, wanted = set(given.get(need.other, ())), " ".join([need.other, *need.values[:1]])
        read = values & set(need.values) if need.values else need.other in given
        if need.option in given and not read:
            raise ConfigError(
                f"{need.option} says nothing without {wanted}",
                todo=f"add {wanted}, or leave it out",
                topic="contradiction",
            )


def _read(words: Sequence[str]) -> dict[str, list[str]]:
    """Values by option; those of a method's hull under the names that visdom-hull has for them."""
    found: dict[str, list[str]] = {}
    name = ""
    for word in words:
        if word.startswith("--") or word == "-k":
            name, equals, value = word.partition("=")
            name = "--k" if name == "-k" else name
            name = f"--{name.removeprefix(_HULL)}" if name.startswith(_HULL) else name
            found[name] = [value] if equals else []
        elif name:
            found[name].append(word)
    return found


def _refuse_two_numbers(given: dict[str, list[str]]) -> None:
    """A list of views by hand has its own number."""
    views, lists = given.get("--views", []), given.get("--train-list", [])
    if not views or not lists:
        return
    count = None
    if lists[0] != "all" and not Path(lists[0]).exists():
        count = len([part for part in lists[0].split(",") if part.strip()])
        if str(count) == views[0]:
            return
    listed = "" if count is None else f", which lists {count}"
    raise ConfigError(
        f"--views {views[0]} and --train-list{listed} both say which views train",
        where=f"--train-list {lists[0][:200]}",
        todo="leave out --views, as the list says how many, or --train-list",
        topic="contradiction",
    )


def _refuse_two_spellings(words: Sequence[str]) -> None:
    """`--k 3 --method.hull.k 2`."""
    names = [word.partition("=")[0] for word in words]
    spelled = [name for name in ("-k", "--k", f"{_HULL}k") if name in names]
    if len(spelled) > 1:
        raise ConfigError(
            f"K is given twice: {' and '.join(spelled)}", todo="leave one of them out", topic="contradiction"
        )
