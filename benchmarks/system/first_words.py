"""What a user sees of a command, and when: seconds to its first words, the longest silence, all in all.

    python benchmarks/system/first_words.py [--show] visdom-hull [OPTION ...]

The command runs twice, on a terminal (where a bar moves) and into a pipe; --show prints what it wrote, each piece
with its second.
"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from itertools import pairwise


def watch(words: list[str], terminal: bool) -> list[tuple[float, str]]:
    """What was written, (seconds since the start, text), and at the end an empty text."""
    ours, theirs = pty.openpty() if terminal else os.pipe()
    began = time.monotonic()
    child = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = []
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:  # the end of a terminal
            piece = b""
        said.append((time.monotonic() - began, piece.decode(errors="replace")))
        if not piece:
            break
    os.close(ours)
    child.wait()
    return said


def main(words: list[str]) -> None:
    show = words[:1] == ["--show"]
    words = words[show:]
    print(f"{'first':>7} {'silence':>8} {'all':>7}  {' '.join(words)}")
    for terminal in (True, False):
        said = watch(words, terminal)
        times = [t for t, _ in said]
        gap, at = max((b - a, a) for a, b in pairwise(times)) if len(times) > 1 else (0, 0)
        place = "terminal" if terminal else "pipe"
        print(f"{times[0]:7.2f} {gap:8.2f} {times[-1]:7.2f}  {place}; silent from {at:.2f} s")
        if show:
            for t, text in said:
                print(f"  {t:7.2f}  {text!r}")


if __name__ == "__main__":
    main(sys.argv[1:])
