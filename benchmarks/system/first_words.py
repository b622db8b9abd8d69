"""What a user sees of a command, and when: seconds to its first words, all in all, and every long silence.

    python benchmarks/system/first_words.py [--show] [--once] [--longest 2] visdom-hull [OPTION ...]

The command runs twice, on a terminal (where a bar moves) and into a pipe (a line comes every five seconds there);
--once leaves the pipe out, --show prints what was written, each piece with its second. Silences are listed, with
the line that stood on the screen and the processor time that the command took, helpers included: on a busy
machine, a silence of little processor time is the machine's fault.
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import subprocess
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path


@dataclass(frozen=True)
class Piece:
    """What was written at once."""

    at: float
    """Seconds since the start."""
    worked: float
    """Seconds of processor time, of the command and its helpers, until then."""
    text: str


@dataclass(frozen=True)
class Silence:
    """A while in which nothing was written."""

    at: float
    seconds: float
    worked: float
    screen: str
    """The line that the user was left with."""


def worked(session: int) -> float:
    """Seconds of processor time of a session's processes, and of their children that have ended."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            # After the name, which may hold spaces: state, parent, group, session, ...
            words = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if int(words[3]) == session:
            ticks += sum(map(int, words[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def watch(words: list[str], terminal: bool) -> list[Piece]:
    """What was written, and at the end an empty piece."""
    ours, theirs = pty.openpty() if terminal else os.pipe()
    began = time.monotonic()
    child = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, start_new_session=True
    )
    os.close(theirs)
    said = []
    while True:
        try:
            read = os.read(ours, 65536)
        except OSError:  # the end of a terminal
            read = b""
        # Before the child is waited for, so that its time is still to be read.
        said.append(Piece(time.monotonic() - began, worked(child.pid), read.decode(errors="replace")))
        if not read:
            break
    os.close(ours)
    child.wait()
    return said


def last_line(text: str) -> str:
    """The line that a terminal shows last, without colours and moves of the cursor."""
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
    lines = [line for line in re.split(r"[\r\n]+", plain) if line.strip()]
    return lines[-1].strip() if lines else ""


def silences(said: list[Piece], longest: float) -> list[Silence]:
    """The gaps between two pieces, and before the first, of more than so many seconds."""
    found, screen = [], ""
    for before, after in pairwise([Piece(0.0, 0.0, ""), *said]):
        screen = last_line(before.text) or screen
        if after.at - before.at > longest:
            found.append(Silence(before.at, after.at - before.at, after.worked - before.worked, screen))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, usage=argparse.SUPPRESS
    )
    parser.add_argument("--show", action="store_true")
    parser.add_argument("--once", action="store_true")
    parser.add_argument("--longest", type=float, default=2.0)
    parser.add_argument("words", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    print(f"{'first':>7} {'silence':>8} {'all':>7}  {' '.join(options.words)}")
    for terminal in (True,) if options.once else (True, False):
        said = watch(options.words, terminal)
        longest = max(silences(said, -1.0), key=lambda silence: silence.seconds)
        place = "terminal" if terminal else "pipe"
        print(f"{said[0].at:7.2f} {longest.seconds:8.2f} {said[-1].at:7.2f}  {place}")
        for silence in silences(said, options.longest):
            print(
                f"  from {silence.at:.1f} s silent for {silence.seconds:.1f} s, "
                f"{silence.worked:.1f} s of processor time, at: {silence.screen}"
            )
        if options.show:
            for piece in said:
                print(f"  {piece.at:7.2f}  {piece.text!r}")


if __name__ == "__main__":
    main()
