"""Early parse: the words that decide which options there are, and how loud a command is.

tyro reads a command line against a class of options with their defaults. Which class, and which defaults, depends
on the method, the config file, the budget and the device, so these are found first; everything is checked by tyro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

WORD = "method:"
"""Prefix of a method's name."""


@dataclass(frozen=True)
class Early:
    """What stands on a command line, not yet checked; of an option given twice, the last value."""

    methods: tuple[str, ...]
    """Names after `method:`."""
    rest: tuple[str, ...]
    """All other words."""
    config: str | None = None
    budget: str | None = None
    device: str | None = None
    views: str | None = None
    quiet: bool = False
    help: bool = False
    version: bool = False
    leave_one_out: bool = False


def read_early(argv: Sequence[str]) -> Early:
    """Reads a command line as far as that needs no defaults."""
    methods = tuple(word[len(WORD) :] for word in argv if word.startswith(WORD))
    rest = [word for word in argv if not word.startswith(WORD)]
    values: dict[str, str] = {}
    for i, word in enumerate(rest):
        name, equals, value = word.partition("=")
        if name in ("--config", "--budget", "--device", "--views") and (equals or i + 1 < len(rest)):
            values[name] = value if equals else rest[i + 1]
    return Early(
        methods=methods,
        rest=tuple(rest),
        config=values.get("--config"),
        budget=values.get("--budget"),
        device=values.get("--device"),
        views=values.get("--views"),
        quiet="--quiet" in rest,
        help="--help" in rest or "-h" in rest,
        version="--version" in rest,
        leave_one_out="--leave-one-out" in rest,
    )
