"""Waiting: what a user sees while nothing else is said, and who is told that a kernel has to be compiled.

Off until a command turns it on; for who calls the package from Python it stays silent.
"""

from __future__ import annotations

import itertools
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

_T = TypeVar("_T")


class Watcher(Protocol):
    """What is told when a kernel that was called has to be compiled, or to be waited for."""

    def began(self) -> None:
        """The kernel is not in the cache."""

    def help(self) -> bool:
        """Compiles another kernel meanwhile; False where there is nothing to do."""

    def ended(self) -> None:
        """The kernel is there."""


_watcher: Watcher | None = None


def watch(watcher: Watcher | None) -> None:
    """Names what is told of this process's kernels."""
    global _watcher
    _watcher = watcher


def current() -> Watcher | None:
    """What is told of this process's kernels."""
    return _watcher


class Screen:
    """A line on stderr that moves while nothing is said: rewritten on a terminal, else one every few seconds."""

    TICK, FIRST, EVERY = 0.25, 1.0, 5.0
    """Seconds between two looks, of silence before the line, and between two lines where there is no terminal."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._phases: list[Callable[[], str]] = []
        self._on = self._drawn = self._again = False
        self._said = 0.0
        self._thread: threading.Thread | None = None

    def turn(self, on: bool) -> None:
        """Shows phases from now on, or no longer."""
        with self._lock:
            self.clear()
            self._on, self._phases = on, []
        if on and self._thread is None:
            self._thread = threading.Thread(target=self._tick, daemon=True, name="what is going on")
            self._thread.start()

    def begin(self, text: Callable[[], str]) -> None:
        """Shows this text, again and again, until `end`."""
        with self._lock:
            self.clear()
            self._phases.append(text)
            self._again = False

    def end(self, text: Callable[[], str]) -> None:
        """Shows what was shown before; without effect where the text is not shown."""
        with self._lock:
            self.clear()
            if text in self._phases:
                self._phases.remove(text)

    def show(self) -> None:
        """On a terminal at once what else is shown after a while: before work that lets no thread write."""
        with self._lock:
            if self._on and self._phases and sys.stderr.isatty():
                self._draw(self._phases[-1], self.FIRST)

    def clear(self) -> None:
        """To be called before something else is written; the line comes back when that was a while ago."""
        with self._lock:
            if self._drawn:
                self._write("\r\x1b[K")
            self._drawn, self._said = False, time.monotonic()

    def _tick(self) -> None:
        while True:
            with self._lock:
                if self._on and self._phases:
                    self._draw(self._phases[-1], time.monotonic() - self._said)
            time.sleep(self.TICK)

    def _draw(self, text: Callable[[], str], silence: float) -> None:
        if hasattr(sys.stderr, "rich_proxied_file"):
            return  # a bar is moving
        if sys.stderr.isatty():
            if self._drawn or silence >= self.FIRST:
                self._write(f"\r\x1b[K{text()}")
                self._drawn = True
        elif silence >= (self.EVERY if self._again else self.FIRST):
            self._write(f"{text()}\n")
            self._again, self._said = True, time.monotonic()

    def _write(self, text: str) -> None:
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except (OSError, ValueError):  # the reader went away
            self._on = False


screen = Screen()
"""Of this process."""
_TELLING = 3
"""Parts done from which on the seconds left are told."""


@contextmanager
def showing(text: Callable[[], str]) -> Iterator[None]:
    """A block that may take seconds, shown by a line that is asked for again and again."""
    screen.begin(text)
    try:
        yield
    finally:
        screen.end(text)


@contextmanager
def phase(name: str) -> Iterator[None]:
    """A block that may take seconds, shown with how long it has taken; usable as a decorator.

    Args:
        name: such as "reading the scene".
    """
    began = time.monotonic()
    with showing(lambda: f"{name}: {time.monotonic() - began:.0f} s"):
        yield


@contextmanager
def counting(name: str, total: int) -> Iterator[Callable[[_T], _T]]:
    """A phase of so many parts alike, shown with how many are done and the seconds left.

    Yields:
        What is to be called with the result of each part, from whatever thread; it returns the result.
    """
    began, numbers, done = time.monotonic(), itertools.count(1), 0

    def finished(result: _T) -> _T:
        nonlocal done
        done = next(numbers)
        return result

    with showing(lambda: describe_parts(name, done, total, time.monotonic() - began)):
        yield finished


def describe_parts(name: str, done: int, total: int, took: float) -> str:
    """How far a phase is, and how long it will take where that can be told.

    Args:
        took: seconds so far.
    """
    text, left = f"{name}: {done} of {total}, {took:.0f} s", seconds_left(done, total, took)
    return text if left is None else f"{text}, about {left} s left"


def seconds_left(done: int, total: int, took: float) -> int | None:
    """Of a phase of parts alike; None where it is too early to tell."""
    if done < _TELLING or took < 1:
        return None
    return math.ceil(took / done * max(total - done, 0))
