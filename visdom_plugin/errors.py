"""Errors of a user, said so that they can be mended, and the numbers and lists of names in them."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import ClassVar

PAGE = "docs/guide/troubleshooting.md"
"""The page that tells more of every topic, under its name."""
TOPICS = (
    # of a class, for what has no narrower one
    "scene", "empty-hull", "setting", "run", "plugin",
    # photographs, masks and poses on disk
    "no-scene", "layout", "missing-file", "damaged-file", "outside-path", "photograph", "photograph-size",
    "mask-missing", "mask-ambiguous", "mask-grey", "poses", "lens", "which-views", "depth",
    # preparing photographs
    "no-board", "several-lenses", "focal-length", "no-object", "unmatched-poses",
    # settings, runs, what is installed, and trainers
    "unknown-name", "contradiction", "other-run", "busy-run", "not-installed", "weights", "render",
)  # fmt: skip
"""What errors are about, beside what findings of the check are called: names that stay, and anchors of `PAGE`."""


class VisDomError(Exception):
    """A user's problem: what is wrong, where, the likely cause, what to do about it.

    Commands print it without a traceback and exit with status 2; programs catch it by its class.

    Args:
        what: One sentence that states the fault and the value seen.
        where: The file, view or field it was found in.
        cause: The likeliest cause, when it could be established.
        todo: What to do, ideally the command to run next.
        topic: What it is about, where that is narrower than the class: one of `TOPICS`, or a finding's kind.
    """

    usual: ClassVar[str] = "setting"
    """The topic of errors of this class that are given none."""

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        cause: str | None = None,
        todo: str | None = None,
        topic: str | None = None,
    ):
        self.what, self.where, self.cause, self.todo = what, where, cause, todo
        self.topic = topic or self.usual
        lines = [what]
        if where is not None:
            lines.append(f"  where: {where}")
        if cause:
            lines.append(f"  likely cause: {cause}")
        if todo:
            lines.append(f"  what to do: {todo}")
        super().__init__("\n".join(lines))


class SceneError(VisDomError):
    """The data on disk, or the cameras and masks handed in, cannot be used as they are."""

    usual = "scene"


class EmptyHullError(VisDomError):
    """No voxel satisfies the keep rule."""

    usual = "empty-hull"


class ConfigError(VisDomError):
    """A setting is out of range or contradicts another."""


class CheckpointError(VisDomError):
    """A run directory or checkpoint cannot be resumed or read."""

    usual = "run"


class PluginError(VisDomError):
    """A method or hook registered from outside cannot be used."""

    usual = "plugin"


def say_more(topic: str) -> str:
    """The line that ends a message of the commands."""
    return f"  more: {PAGE}#{topic}"


def list_some(names: Iterable[object], most: int = 5) -> str:
    """Names with commas between, "a, b, c, ... (9 in all)" where there are more than `most`."""
    words = [str(name) for name in names]
    return ", ".join(words[:most]) + (f", ... ({len(words)} in all)" if len(words) > most else "")


def count_of(number: int, one: str, many: str | None = None) -> str:
    """ "1 view" or "3 views"; `many` where an s is not enough."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def did_you_mean(name: object, valid: Iterable[object]) -> str:
    """ "; did you mean 'steps'?" for the nearest of the valid names; empty where none is near."""
    near = difflib.get_close_matches(str(name), [str(v) for v in valid], 1, 0.5)
    return f"; did you mean {near[0]!r}?" if near else ""


def unknown_name(
    what: str,
    name: object,
    valid: Iterable[object],
    *,
    where: object = None,
    cause: str | None = None,
    todo: str = "use one of",
) -> ConfigError:
    """The error for a name that is none of the valid ones: says the nearest and lists all.

    Args:
        what: The sentence that names it, e.g. "there is no metric 'pnsr'".
        name: The name itself.
        todo: What stands before the list.
    """
    names = [str(v) for v in valid]
    return ConfigError(
        what + did_you_mean(name, names),
        where=where,
        cause=cause,
        todo=f"{todo}: {', '.join(names) or '(there is none)'}",
        topic="unknown-name",
    )
