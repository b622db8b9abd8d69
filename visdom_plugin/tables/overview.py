"""How far a table is, over all its jobs: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from visdom_plugin.tables.jobs import Plan, Task
from visdom_plugin.tables.results import Outcome
from visdom_plugin.tables.state import read_step

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
        self._bar: Any = None
        self._plan: Plan | None = None
        self._known: Mapping[Path, Outcome] = {}
        self._shown = 0.0

    def __enter__(self) -> Overview:
        return self

    def __exit__(self, *_) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def begin(self, plan: Plan, known: Mapping[Path, Outcome], to_run: int) -> None:
        """Says what there is to do."""
        self._plan, self._known = plan, known
        self._begin = self._shown = time.monotonic()
        self._share_before = (len(known) - to_run) / max(len(known), 1)
        if self.quiet:
            return
        if to_run and self.stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            self._bar = Progress(
                TextColumn("jobs"),
                BarColumn(),
                TextColumn("{task.fields[note]}"),
                TimeElapsedColumn(),
                console=Console(file=self.stream),
                refresh_per_second=4,
            )
            self._bar.start()
            self._line = self._bar.add_task("", total=1.0, note="")
        self._say(f"{len(known)} runs in all, {len(known) - to_run} of them done before, {to_run} to do")

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
        self._draw()

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

    def _summarise(self) -> tuple[str, float]:
        known = list(self._known.items())
        counts = {s: sum(o.status == s for _, o in known) for s in ("finished", "failed", "running")}
        done = counts["finished"] + counts["failed"]
        shares = {d: self._share(d, o) for d, o in known}
        share = sum(shares.values()) / max(len(shares), 1)
        note = f"{done}/{len(known)} done, {counts['running']} running"
        note += f", {counts['failed']} failed" if counts["failed"] else ""
        left = self._estimate(shares, share)
        if left is not None and done < len(known):
            note += f", about {spell_seconds(left)} left"
        return note, share

    def _share(self, run_dir: Path, outcome: Outcome) -> float:
        if outcome.status in ("finished", "failed"):
            return 1.0
        steps = self._plan.tasks[run_dir].steps
        # After the last step comes the evaluation.
        return 0.9 * min(read_step(run_dir) / steps, 1.0) if outcome.status == "running" and steps else 0.0

    def _estimate(self, shares: dict[Path, float], share: float) -> float | None:
        """Seconds left: by what finished runs of the same method, or of any, took on average; before the first, by
        the steps done since the begin."""
        took: dict[str, list[float]] = {}
        for run_dir, outcome in self._known.items():
            timing = (outcome.record or {}).get("timing") or {}
            seconds = sum(
                v for k in ("hull_s", "train_s", "eval_s") if isinstance(v := timing.get(k), (int, float))
            )
            if seconds:
                took.setdefault(self._plan.tasks[run_dir].method, []).append(seconds)
        every = [s for values in took.values() for s in values]
        if not every:
            gained = share - self._share_before
            return (time.monotonic() - self._begin) * (1 - share) / gained if gained > 0 else None
        left = 0.0
        for run_dir, share in shares.items():
            values = took.get(self._plan.tasks[run_dir].method, every)
            left += (1 - share) * sum(values) / len(values)
        return left / max(1, sum(o.status == "running" for o in self._known.values()))


def spell_seconds(seconds: float) -> str:
    """A duration for people: "40 s", "3 min", "2 h 05 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
