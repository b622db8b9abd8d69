"""What a user sees while a run goes on: a bar on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


class Progress:
    """Shows how far it is, what was measured and the time left. As a context manager; silent when quiet."""

    def __init__(
        self,
        total: int,
        start: int = 0,
        *,
        title: str = "training",
        unit: str = "step",
        quiet: bool = False,
        stream: TextIO | None = None,
    ):
        """
        Args:
            total: steps in all.
            start: steps done before, by an earlier process.
            title: before the bar.
            unit: what is counted, before each line.
            stream: where to write, by default stderr.
        """
        self.total, self.start, self.title, self.unit, self.quiet = total, start, title, unit, quiet
        self.stream = sys.stderr if stream is None else stream
        self._bar: Bar | None = None
        self._shown = 0.0

    def __enter__(self) -> Progress:
        self._begin = self._shown = time.monotonic()
        if not self.quiet and self.stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = bar = Bar(
                TextColumn(self.title),
                BarColumn(),
                TextColumn("{task.completed}/{task.total} {task.fields[note]}"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(file=self.stream),
                refresh_per_second=4,
            )
            bar.start()
            self._task = bar.add_task("", total=self.total, completed=self.start, note="")
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def say(self, text: str) -> None:
        """A line above the bar, or between two lines of progress."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False, soft_wrap=True)
        elif not self.quiet:
            print(text, file=self.stream, flush=True)

    def show(
        self,
        done: int,
        loss: float | None = None,
        psnr: float | None = None,
        summary: Mapping[str, int] | None = None,
        every: float = 5,
    ) -> None:
        """Reports that `done` steps are done.

        Args:
            loss: of the last step measured.
            psnr: of a training view, dB.
            summary: numbers of the model by name, {"gaussians": 6000}.
            every: seconds between two lines when there is no terminal.
        """
        if self.quiet:
            return
        note = "" if loss is None else f"loss {loss:.4f}"
        note += "" if psnr is None else f"  train PSNR {psnr:.2f}"
        note += "".join(f"  {count:,} {name.capitalize()}" for name, count in (summary or {}).items())
        if self._bar is not None:
            self._bar.update(self._task, completed=done, note=note)
            return
        now = time.monotonic()
        if now - self._shown >= every or done == self.total:
            self._shown = now
            left = (now - self._begin) / max(done - self.start, 1) * (self.total - done)
            line = "  ".join(filter(None, (f"{self.unit} {done}/{self.total}", note, f"{left:.0f} s left")))
            print(line, file=self.stream, flush=True)
