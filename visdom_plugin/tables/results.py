"""Jobs of a table and their outcomes, which executors fill in and writers read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from visdom_plugin.tables.spec import TableSpec

Status = Literal["finished", "failed", "running", "waiting", "not available", "no data"]
"""finished: `record` holds run.json. failed: `error` says why. running, waiting: not done yet, the table is a
partial one. not available: this installation has no such method. no data: the column's data root is not here."""


@dataclass(frozen=True)
class Job:
    """One row on one scene of one column, at one number of views, with one seed."""

    row: int
    """Position in `spec.rows`."""
    column: int
    """Position in `spec.columns`."""
    scene: str
    views: int
    seed: int
    run_dir: Path | None = None
    """Where run.json, renders/ and log.jsonl are, or will be; None where there is nothing to run. Two jobs that
    come to the same settings share one."""
    argv: tuple[str, ...] = ()
    """Arguments of the command that makes `run_dir`."""


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    status: Status
    record: dict[str, Any] | None = None
    """run.json's content, of finished ones."""
    error: str | None = None
    """Of failed ones: the message, as a user would have seen it."""


@dataclass(frozen=True)
class Results:
    """The table's jobs with their outcomes, in the order rows, columns, scenes, views, seeds."""

    spec: TableSpec
    outcomes: dict[Job, Outcome] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether nothing is left to run."""
        return all(o.status not in ("running", "waiting") for o in self.outcomes.values())

    def select(
        self, row: int | None = None, column: int | None = None, views: int | None = None
    ) -> Iterator[tuple[Job, Outcome]]:
        """Jobs of one row, column and number of views; None takes all."""
        for job, outcome in self.outcomes.items():
            wanted = (row, column, views)
            has = (job.row, job.column, job.views)
            if all(w is None or w == h for w, h in zip(wanted, has, strict=True)):
                yield job, outcome
