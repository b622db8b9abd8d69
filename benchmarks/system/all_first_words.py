"""Seconds to the first words of every command: with --help, and where it begins its work.

    python benchmarks/system/all_first_words.py [REPEATS]

Work is on the built-in scene, or on a short run of it that is trained before. Each command runs on a terminal and
is ended when it has said something; the least of the repeats. `first_words.py` shows one command to its end.
"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PREPARATION = (
    ["visdom-train", "method:3dgs-go+vd", "--method.steps", "3", "--no-report", "--quiet", "--out", "run"],
    ["visdom-export", "run", "--format", "dataset", "--out", "data"],
)
STARTS = {
    "visdom-train": ["method:3dgs-go+vd"],
    "visdom-hull": [],
    "visdom-check": [],
    "visdom-eval": ["run"],
    "visdom-render": ["run"],
    "visdom-export": ["run", "--format", "glb"],
    "visdom-report": ["run"],
    "visdom-view": ["run"],
    "visdom-table": ["main:smoke"],
    "visdom-prepare": ["photos", "--out", "scene"],
    "visdom-convert": ["data", "--out", "calibration.csv"],
    "visdom-methods": [],
}
"""Words of each command that begin its work, in a folder with a run, a data set and its photographs."""


def first_words(words: list[str], folder: Path) -> tuple[float, str]:
    """Seconds from the start of a command, and what it said first; the command is ended."""
    ours, theirs = pty.openpty()
    began = time.monotonic()
    with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, cwd=folder) as child:
        os.close(theirs)
        try:
            said = os.read(ours, 65536)
        except OSError:  # it ended without a word
            said = b""
        seconds = time.monotonic() - began
        child.kill()
    os.close(ours)
    return seconds, said.decode(errors="replace").replace("\x1b[K", "").strip().partition("\n")[0].strip()


def main(repeats: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for words in PREPARATION:
            subprocess.run(words, cwd=folder, check=True, capture_output=True)
        pictures = next(path for path in (folder / "data").rglob("*.png") if "mask" not in str(path))
        (folder / "photos").symlink_to(pictures.parent)
        print(f"{'--help':>7} {'start':>7}")
        for command, start in STARTS.items():
            helped, began = (
                min(first_words([command, *words], folder) for _ in range(repeats))
                for words in (["--help"], start)
            )
            print(f"{helped[0]:7.2f} {began[0]:7.2f}  {' '.join([command, *start])}: {began[1]}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 3)
