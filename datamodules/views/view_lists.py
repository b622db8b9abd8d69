"""Lists of views given by hand: positions and names on the command line, or an index file anywhere on the disk.

A number may be a position (zero-based, in the layout's order) and at the same time the name of another photograph
(1.png, 2.png, ... sort as 1, 10, 11, ...). A file of numbers alone holds positions, like a scene's own index
files; everywhere else a number with two meanings is refused.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from datamodules.files.paths import read_plain
from visdom_plugin.errors import ConfigError


def read_list(text: str, names: Sequence[str], where: str) -> list[int]:
    """Positions of the listed views, in the order of the list.

    Args:
        text: positions and names (with or without ending and folder) with commas between, or the path of a file
            that holds them one per line or with commas between; blanks part numbers, and names that have none.
        names: of all views, in the layout's order.
        where: the option, for errors.

    Raises:
        ConfigError: a word that is no view or could be two; no views, or one twice; a file that cannot be read.
    """
    known = _Names.of(names)
    content = _read_file(text, where)
    if content is None:
        numbers, words = False, _parts(text)
    else:
        numbers, words = _split_file(content, known)
    place = f"{where} {text[:200]}"
    positions = []
    for word in words:
        named, numbered = known.places.get(word), known.position(word)
        if numbers and word == str(numbered):
            named = None
        position = numbered if named is None else named
        if position is None:
            raise ConfigError(
                f"{where} names {word[:60]!r}, which is no view of this scene",
                where=place,
                cause=None if content is not None or "," in text else "there is no such file either",
                todo=f"list positions from 0 to {len(names) - 1} or names such as {names[0]}, with commas between",
                topic="which-views",
            )
        if named is not None and numbered is not None and named != numbered:
            _refuse_two(word, names[named], names[numbered], numbered, place)
        positions.append(position)
    if not positions or len(set(positions)) < len(positions):
        raise ConfigError(
            f"{where} lists {'a view twice' if positions else 'no views'}", where=place, topic="which-views"
        )
    return positions


def is_integer(word: str) -> bool:
    """Whether a word is a whole number in ASCII digits, of a length that any list could mean."""
    return word.isascii() and word.removeprefix("-").isdecimal() and len(word) < 12


class _Names(NamedTuple):
    places: dict[str, int]
    """Positions by name, with and without ending and folder."""
    total: int
    """Number of views."""

    @classmethod
    def of(cls, names: Sequence[str]) -> _Names:
        paths = [PurePosixPath(name) for name in names]
        # Without its folder a name may stand for several views, and then for none.
        counts = Counter(short for path in paths for short in {path.name, path.stem})
        short = {s: i for i, path in enumerate(paths) for s in (path.stem, path.name) if counts[s] == 1}
        bare = {path.with_suffix("").as_posix(): i for i, path in enumerate(paths)}
        return cls(short | bare | {name: i for i, name in enumerate(names)}, len(names))

    def position(self, word: str) -> int | None:
        return int(word) if is_integer(word) and 0 <= int(word) < self.total else None

    def holds(self, word: str) -> bool:
        return word in self.places or self.position(word) is not None


def _read_file(text: str, where: str) -> str | None:
    """The text of the file of that name, None where there is none."""
    path = Path(text).expanduser() if text.startswith("~") else Path(text)
    try:
        is_file = path.is_file()
    except (OSError, ValueError):
        is_file = False
    if not is_file:
        return None
    try:
        return read_plain(path, 2**24).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise ConfigError(f"the list cannot be read: {error.strerror}", where=f"{where} {text}") from error


def _split_file(content: str, known: _Names) -> tuple[bool, list[str]]:
    """Whether a file holds positions alone, and its words."""
    words = content.replace(",", " ").split()
    if all(map(is_integer, words)):
        # Numbers none of which is a position, such as 1034 and 1035, can only be names.
        return any(known.position(word) is not None for word in words), words
    parts = _parts(content)
    if all(map(known.holds, parts)) or not all(map(known.holds, words)):
        return False, parts
    return False, words


def _parts(text: str) -> list[str]:
    return [part.strip() for part in re.split(r"[,\r\n]", text) if part.strip()]


def _refuse_two(word: str, named: str, numbered: str, position: int, place: str) -> None:
    todo = "put positions alone, without leading zeros, into a file and pass that"
    raise ConfigError(
        f"{word} could be the view named {named}, or position {position}, which is {numbered}",
        where=place,
        cause="photographs named by numbers, whose order by name is not that of the numbers",
        todo=todo
        if named == word
        else f"write {named} for the first and {numbered} for the second; or {todo}",
        topic="which-views",
    )
