"""What compiling costs before the first step of a command on a new machine.

    python benchmarks/system/compiling.py [--kernels] visdom-train method:zipnerf+vd [OPTION ...]

The command runs to its first training step (to its end where it does not train), into a throw-away folder: in turn
with an empty cache of kernels and with the one that the first run filled. Seconds of wall time and of all
processes' processor time. --kernels lists what was compiled, for which types, and how long that took without the
functions it called.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from visdom_plugin.compute import ahead

RUNS = int(os.environ.get("RUNS", 2))


def run_to_first_step(words: list[str], kernels: bool) -> None:
    """In the measured process: the command, until its first step is shown."""
    from importlib import import_module
    from importlib.metadata import entry_points

    from visdom_plugin.training.progress import Progress

    listed = list_kernels() if kernels else None
    show = Progress.show

    def first(self: Progress, *arguments: Any, **named: Any) -> None:
        if self.title == "training":
            finish(listed)
        show(self, *arguments, **named)

    Progress.show = first  # type: ignore[method-assign]
    name, *rest = words
    (entry,) = (e for e in entry_points(group="console_scripts") if e.name == name)
    getattr(import_module(entry.module), entry.attr)(rest)
    finish(listed)


def finish(listed: list[tuple[float, str]] | None) -> None:
    """Ends the process, in the way of a command that has come to its first step."""
    if listed is not None:
        counts = Counter(text.split("(")[0] for _, text in listed)
        for seconds, text in sorted(listed, reverse=True):
            print(f"{seconds:7.2f} s  {text}")
        again = {name: n for name, n in counts.items() if n > 1}
        print(f"{sum(s for s, _ in listed):7.2f} s  in all, {len(listed)} kernels; more than once: {again}")
    sys.stdout.flush()
    ahead.finish()  # so that the second process's seconds count
    os._exit(0)


def list_kernels() -> list[tuple[float, str]]:
    """A list that grows by (seconds without what it called, name and types) per function compiled."""
    from numba.core import event

    listed: list[tuple[float, str]] = []
    stack: list[list[float]] = []

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            stack.append([time.process_time(), 0.0])

        def on_end(self, event: Any) -> None:
            began, inner = stack.pop()
            took = time.process_time() - began
            if stack:
                stack[-1][1] += took
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__}.{function.__qualname__}{event.data['args']}"
            listed.append((took - inner, name))

    event.register("numba:compile", Listener())
    return listed


def measure(words: list[str], cache: Path, flags: list[str]) -> tuple[float, float]:
    """(wall seconds, processor seconds) of one run to the first step."""
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        began = time.monotonic()
        out = ["--out", f"{folder}/run"] if words[0] == "visdom-train" else []
        subprocess.run(
            [sys.executable, __file__, "--child", *flags, *words, *out],
            env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
            stderr=None if flags else subprocess.DEVNULL,
            stdout=None if flags else subprocess.DEVNULL,
            check=True,
            cwd=folder,
        )
        wall = time.monotonic() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(words: list[str]) -> None:
    child, kernels = "--child" in words, "--kernels" in words
    words = [word for word in words if word not in ("--child", "--kernels")]
    if child:
        return run_to_first_step(words, kernels)
    rows: dict[str, list[tuple[float, float]]] = {"empty cache": [], "filled cache": []}
    for _ in range(1 if kernels else RUNS):
        with tempfile.TemporaryDirectory() as cache:
            for row in rows.values():
                row.append(measure(words, Path(cache), ["--kernels"] if kernels else []))
                if kernels:
                    break
    if kernels:
        return None
    print(f"{'wall s':>8} {'cpu s':>8}  {' '.join(words)}")
    best = {name: [min(column) for column in zip(*row, strict=True)] for name, row in rows.items()}
    best["difference"] = [a - b for a, b in zip(*best.values(), strict=True)]
    for name, (wall, cpu) in best.items():
        print(f"{wall:8.2f} {cpu:8.2f}  {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
