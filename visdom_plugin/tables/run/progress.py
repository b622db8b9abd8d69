"""Progress of a table over all its jobs: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from visdom_plugin.tables.results import Outcome
from visdom_plugin.tables.run.job_files import read_step
from visdom_plugin.tables.run.jobs import Task

if TYPE_CHECKING:
    from rich.progress import Progress

EVERY = 30.0
"""Seconds between two lines where there is no terminal."""


class Overview:
    """Shows jobs done, running and failed, and the time left. As a context manager; silent when quiet."""

    def __init__(self, *, quiet: bool = False, stream: TextIO | None = None):
        """
        Args:
            stream: where to write, by default stderr.
        """
        self.quiet = quiet
        self.stream = sys.stderr if stream is None else stream
        self._bar: Progress | None = None
        self._tasks: Mapping[Path, Task] = {}
        self._known: Mapping[Path, Outcome] = {}
        self._shown = 0.0

    def __enter__(self) -> Overview:
        return self

    def __exit__(self, *_) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def begin(self, tasks: Mapping[Path, Task], known: Mapping[Path, Outcome]) -> None:
        """Says what there is to do of some tasks, by run directory; those that are waiting are to be run."""
        self._tasks, self._known = tasks, known
        self._begin = self._shown = time.monotonic()
        if self.quiet:
            return
        counts = self._count()
        self._before = {d: self._reached(d) for d in tasks if known[d].status == "waiting"}
        if counts["waiting"] and self.stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            self._bar = bar = Progress(
                TextColumn("jobs"),
                BarColumn(),
                TextColumn("{task.fields[note]}"),
                TimeElapsedColumn(),
                console=Console(file=self.stream),
                refresh_per_second=4,
            )
            bar.start()
            self._line = bar.add_task("", total=1.0, note="")
        failed = f", {counts['failed']} failed before" if counts["failed"] else ""
        self._say(
            f"{len(tasks)} run{'s' * (len(tasks) != 1)} in all, {counts['finished']} of them done before{failed}, "
            f"{counts['waiting']} to do"
        )

    def show(self, known: Mapping[Path, Outcome]) -> None:
        """Brings the display up to date; to be called often."""
        self._known = known
        now = time.monotonic()
        if self.quiet or now - self._shown < (1.0 if self._bar is not None else EVERY):
            return
        self._shown = now
        self._draw()

    def tick(self) -> None:
        """The same, from a thread, while the driver is busy."""
        self.show(self._known)

    def report(self, task: Task, outcome: Outcome) -> None:
        """Says what became of one task."""
        if self.quiet:
            return
        if outcome.status == "failed":
            self._say(f"failed: {task.label}\n  " + (outcome.error or "").replace("\n", "\n  "))
        elif self._bar is None:
            self._say(f"finished: {task.label}")
        # Not drawn at once: what runs next is not started yet.
        self._shown = -math.inf

    def _draw(self) -> None:
        note, share = self._summarise()
        if self._bar is not None:
            self._bar.update(self._line, completed=share, note=note)
        else:
            print(note, file=self.stream, flush=True)

    def _say(self, text: str) -> None:
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            print(text, file=self.stream, flush=True)

    def _count(self) -> Counter[str]:
        return Counter(self._known[run_dir].status for run_dir in self._tasks)

    def _summarise(self) -> tuple[str, float]:
        counts = self._count()
        shares = {run_dir: self._share(run_dir) for run_dir in self._tasks}
        done = counts["finished"] + counts["failed"]
        note = f"{done}/{len(shares)} done, {counts['running']} running"
        note += f", {counts['failed']} failed" if counts["failed"] else ""
        left = self._estimate(shares, counts["running"])
        if left is not None:
            note += f", about {spell_seconds(left)} left"
        return note, sum(shares.values()) / max(len(shares), 1)

    def _share(self, run_dir: Path) -> float:
        status = self._known[run_dir].status
        if status in ("finished", "failed"):
            return 1.0
        return self._reached(run_dir) if status == "running" else 0.0

    def _reached(self, run_dir: Path) -> float:
        steps = self._tasks[run_dir].steps
        # After the last step comes the evaluation.
        return 0.9 * min(read_step(run_dir) / steps, 1.0) if steps else 0.0

    def _estimate(self, shares: Mapping[Path, float], running: int) -> float | None:
        """Seconds left: by what finished runs of the same method, or of any, took on average; before the first, by
        the steps done since the begin. None where nothing runs or nothing is known yet."""
        if not running:
            return None
        took: dict[str, list[float]] = {}
        for run_dir, task in self._tasks.items():
            timing = (self._known[run_dir].record or {}).get("timing") or {}
            seconds = sum(
                v for k in ("hull_s", "train_s", "eval_s") if isinstance(v := timing.get(k), (int, float))
            )
            if seconds:
                took.setdefault(task.method, []).append(seconds)
        every = [s for values in took.values() for s in values]
        to_do = len(shares) - sum(shares.values())
        if not every:
            gained = sum(max(shares[run_dir] - share, 0.0) for run_dir, share in self._before.items())
            return (time.monotonic() - self._begin) * to_do / gained if gained > 0 else None
        left = 0.0
        for run_dir, share in shares.items():
            values = took.get(self._tasks[run_dir].method, every)
            left += (1 - share) * sum(values) / len(values)
        return left / running


def spell_seconds(seconds: float) -> str:
    """A duration for people: "40 s", "3 min", "2 h 05 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
