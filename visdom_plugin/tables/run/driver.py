"""Runs a table: starts what is not done, judges what ended, writes the table whenever something changed.

Everything is on disk and nothing in the driver: killed at any moment, it is resumed by the same command. Several
drivers may work on one folder; a run belongs to whoever holds its directory, and the others wait for it.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from visdom_plugin.tables.protocol import check_records
from visdom_plugin.tables.results import Outcome, Results
from visdom_plugin.tables.run import job_files
from visdom_plugin.tables.run.executors import INTERRUPTED, Ended, Executor
from visdom_plugin.tables.run.jobs import Plan, Task
from visdom_plugin.tables.run.progress import Overview

log = logging.getLogger(__name__)

CHANCES = 3
"""A task whose process is killed this many times without getting a step further has failed."""
BUSY_PAUSE = 2.0
"""Seconds between two looks at a run directory that another process holds."""

Writer = Callable[[Results], object]


class Interrupted(KeyboardInterrupt):
    """A signal stopped the table; the same command resumes it."""


@dataclass
class _Watched:
    """What the driver remembers of a task that is not done."""

    task: Task
    deaths: int = 0
    step: int = 0
    not_before: float = 0.0


def look(plan: Plan) -> dict[Path, Outcome]:
    """What is on disk of every task."""
    return {run_dir: job_files.read_outcome(run_dir) for run_dir in plan.tasks}


def gather(plan: Plan, known: dict[Path, Outcome]) -> Results:
    """The table's results from what is known of its tasks."""
    outcomes = {}
    for job, outcome in plan.jobs.items():
        outcomes[job] = known[job.run_dir] if outcome.status == "waiting" and job.run_dir else outcome
    return Results(plan.spec, outcomes)


def run_plan(
    plan: Plan,
    executor: Executor,
    write: Writer,
    *,
    retry: bool = False,
    only: Sequence[int] | None = None,
    overview: Overview | None = None,
) -> Results:
    """Runs a table's jobs to their ends.

    Args:
        write: writes the table of some results; called when something changed, and at the end.
        retry: try failed jobs again.
        only: positions of the rows to run; the others show what there is.
        overview: shows how far the table is.

    Raises:
        ConfigError: when finished runs turn out to be of different protocols.
        Interrupted: after Ctrl-C or SIGTERM; what was running can be resumed, the table is written.
    """
    asked_for = {j.run_dir for j in plan.jobs if only is None or j.row in only}
    wanted = {run_dir: task for run_dir, task in plan.tasks.items() if run_dir in asked_for}
    if retry:
        for run_dir in wanted:
            job_files.forget_error(run_dir)
    known = look(plan)
    queue = [
        _Watched(task, step=job_files.read_step(run_dir))
        for run_dir, task in wanted.items()
        if known[run_dir].status == "waiting" or (retry and known[run_dir].status == "failed")
    ]
    for entry in queue:
        known[entry.task.run_dir] = Outcome("waiting")
    for name, versions in _changes(known).items():
        log.warning(
            "runs of this table were made with different versions of %s: %s", name, ", ".join(versions)
        )
    overview = overview or Overview(quiet=True)
    table = _Table(plan, known, write)
    with overview, _term_interrupts():
        overview.begin(wanted, known)
        try:
            table.write()
            _work(queue, executor, table, overview)
        except BaseException as stop:
            executor.stop()
            for run_dir, outcome in known.items():
                if outcome.status == "running":
                    known[run_dir] = job_files.read_outcome(run_dir)
            if isinstance(stop, KeyboardInterrupt):
                raise Interrupted from None
            raise
        finally:
            table.write()
    return gather(plan, known)


class _Table:
    """Writes the table, not much more often than it takes to write it."""

    def __init__(self, plan: Plan, known: dict[Path, Outcome], write: Writer):
        self.plan, self.known, self._write = plan, known, write
        self._took = self._last = 0.0
        self.stale = True

    def write(self) -> None:
        results = gather(self.plan, self.known)
        check_records(results)
        began = time.monotonic()
        self._write(results)
        self._last = time.monotonic()
        self._took, self.stale = self._last - began, False

    def refresh(self) -> None:
        """Writes if something changed and the last time is long enough ago."""
        if self.stale and time.monotonic() - self._last >= 10 * self._took:
            self.write()


def _work(queue: list[_Watched], executor: Executor, table: _Table, overview: Overview) -> None:
    known = table.known
    active: dict[Path, _Watched] = {}
    adopted = {task.run_dir for task in executor.adopt([entry.task for entry in queue])}
    for entry in [e for e in queue if e.task.run_dir in adopted]:
        queue.remove(entry)
        active[entry.task.run_dir] = entry
        known[entry.task.run_dir] = Outcome("running")
    while queue or active:
        _start(queue, active, executor, table)
        queued = executor.queued()
        for run_dir in active:
            known[run_dir] = Outcome("waiting" if run_dir in queued else "running")
        overview.show(known)
        for ended in executor.poll():
            entry = active.pop(ended.task.run_dir)
            outcome = _judge(entry, ended)
            known[ended.task.run_dir] = outcome
            if outcome.status == "waiting":
                queue.append(entry)
            else:
                table.stale = True
                overview.report(ended.task, outcome)
        table.refresh()
        if (queue or active) and executor.pause:
            time.sleep(executor.pause)
        elif queue and not active:
            time.sleep(0.2)
    overview.show(known)


def _start(queue: list[_Watched], active: dict[Path, _Watched], executor: Executor, table: _Table) -> None:
    known = table.known
    ready: list[_Watched] = []
    for entry in queue:
        if len(ready) >= executor.free():
            break
        now = time.monotonic()
        if now < entry.not_before:
            continue
        run_dir = entry.task.run_dir
        if job_files.is_held(run_dir):
            known[run_dir] = Outcome("running")
            entry.not_before = now + BUSY_PAUSE
            continue
        ready.append(entry)
    for entry in list(ready):
        # Another driver may have brought it to an end in the meantime.
        outcome = job_files.read_outcome(entry.task.run_dir)
        if outcome.status == "finished" or job_files.has_error(entry.task.run_dir):
            ready.remove(entry)
            queue.remove(entry)
            known[entry.task.run_dir] = outcome
            table.stale = True
    for entry in ready:
        queue.remove(entry)
        active[entry.task.run_dir] = entry
        entry.task.write_settings()
        known[entry.task.run_dir] = Outcome("running")
    if ready:
        executor.start([entry.task for entry in ready])


def _judge(entry: _Watched, ended: Ended) -> Outcome:
    """What the end of a task's process means: finished, failed, or to be run again ("waiting")."""
    run_dir = ended.task.run_dir
    outcome = job_files.read_outcome(run_dir)
    busy = job_files.BUSY in ended.said and ended.code == 2
    if ended.code is not None and not busy:
        job_files.keep_log(run_dir, ended.said)
    if outcome.status == "finished" or job_files.has_error(run_dir):
        # Maybe by another driver.
        return outcome
    if busy:
        entry.not_before = time.monotonic() + BUSY_PAUSE
        return Outcome("waiting")
    if ended.code is None or ended.code < 0 or ended.code == INTERRUPTED:
        step = job_files.read_step(run_dir)
        entry.deaths = 1 if step > entry.step else entry.deaths + 1
        entry.step = step
        if entry.deaths < CHANCES:
            return Outcome("waiting")
    error = job_files.explain_exit(ended.code or 0, ended.said) if ended.code is not None else _LOST
    job_files.note_error(run_dir, error)
    return Outcome("failed", error=error)


_LOST = f"the process disappeared {CHANCES} times without an exit status and without getting a step further"


def _changes(known: dict[Path, Outcome]) -> dict[str, list[str]]:
    """Packages of which finished runs note more than one version."""
    seen: dict[str, set[str]] = {}
    for outcome in known.values():
        for name, version in ((outcome.record or {}).get("versions") or {}).items():
            if name in ("visdom-plugin", "torch"):
                seen.setdefault(name, set()).add(str(version))
    return {name: sorted(versions) for name, versions in seen.items() if len(versions) > 1}


@contextmanager
def _term_interrupts() -> Iterator[None]:
    """SIGTERM interrupts like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number, frame) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
