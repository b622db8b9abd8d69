"""Executors: run tasks in this process, or in N processes of this machine. `slurm` has the cluster.

Executors start tasks and say which ones ended; what an end means is the driver's to judge, from the run directory.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import IO, Protocol

from visdom_plugin.tables.run.job_files import read_json
from visdom_plugin.tables.run.jobs import Task

INTERRUPTED = 130
"""Exit status of a command that a signal stopped in an orderly way."""
PATIENCE = 60.0
"""Seconds that children have to save their state when the driver is stopped."""


@dataclass(frozen=True)
class Ended:
    """A task whose process is gone."""

    task: Task
    code: int | None
    """Exit status, negative for a signal, None where it is not known."""
    said: str = ""
    """What it wrote on stderr."""


class Executor(Protocol):
    """Runs tasks."""

    pause: float
    """Seconds between two polls."""

    def free(self) -> int:
        """How many more tasks it takes now."""
        ...

    def adopt(self, tasks: Sequence[Task]) -> list[Task]:
        """Those of the tasks that an earlier driver left running here; they are polled like started ones."""
        return []

    def start(self, tasks: Sequence[Task]) -> None:
        """Starts up to `free()` tasks, whose settings are written."""
        ...

    def queued(self) -> Collection[Path]:
        """Run directories of started tasks that still wait for a place to run."""
        return ()

    def poll(self) -> list[Ended]:
        """Tasks that ended since the last call."""
        ...

    def stop(self) -> None:
        """Stops what would end with the driver, in a state that can be resumed, and waits for it."""
        return None


class Here(Executor):
    """One task at a time, in this process. `tick` is called at its start and every two seconds while it runs."""

    pause = 0.0

    def __init__(self, tick: Callable[[], None] = lambda: None):
        self.tick = tick
        self._ended: list[Ended] = []

    def free(self) -> int:
        return 1 - len(self._ended)

    def start(self, tasks: Sequence[Task]) -> None:
        for task in tasks:
            said, done = io.StringIO(), threading.Event()
            levels = {name: logging.getLogger(name).level for name in ("visdom_plugin", "datamodules")}
            self.tick()
            ticker = threading.Thread(target=self._watch, args=(done,), daemon=True)
            ticker.start()
            try:
                with contextlib.redirect_stderr(said):
                    code = int(import_module(task.module).main(list(task.argv)) or 0)
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 1
            except Exception:
                code = 1
                said.write(traceback.format_exc())
            finally:
                done.set()
                ticker.join()
                for name, level in levels.items():
                    logging.getLogger(name).setLevel(level)
            if code == INTERRUPTED:
                # The signal was meant for the whole table.
                raise KeyboardInterrupt
            self._ended.append(Ended(task, code, said.getvalue()))

    def poll(self) -> list[Ended]:
        ended, self._ended = self._ended, []
        return ended

    def _watch(self, done: threading.Event) -> None:
        while not done.wait(2):
            self.tick()


class Local(Executor):
    """N processes of this machine, the cores divided among them.

    A child whose driver dies is told to stop by the kernel (Linux) and leaves a state that can be resumed.
    """

    pause = 0.2

    def __init__(self, workers: int, threads: int | None = None):
        """
        Args:
            workers: processes at a time.
            threads: of each; by default the machine's cores divided by the workers.
        """
        self.workers = workers
        self.threads = threads or max(1, count_cores() // workers)
        self._children: dict[subprocess.Popen, tuple[Task, IO[bytes]]] = {}
        """With what they say on stderr."""

    def free(self) -> int:
        return self.workers - len(self._children)

    def start(self, tasks: Sequence[Task]) -> None:
        for task in tasks:
            # Without a name: no other driver's child can write to it, and no killed driver leaves it behind.
            said = tempfile.TemporaryFile()  # noqa: SIM115
            child = subprocess.Popen(
                worker_command(task.module, task.argv),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=said,
                # A run goes on with the threads it began with: its result depends on them in the last digits.
                env=environment((read_json(task.run_dir / "run.json") or {}).get("threads") or self.threads),
                # Ctrl-C in a terminal reaches the driver alone, which then stops its children once.
                start_new_session=True,
            )
            self._children[child] = task, said

    def poll(self) -> list[Ended]:
        ended = []
        for child, (task, said) in list(self._children.items()):
            if child.poll() is not None:
                del self._children[child]
                ended.append(Ended(task, child.returncode, read_all(said)))
        return ended

    def stop(self) -> None:
        for child in self._children:
            child.terminate()
        until = time.monotonic() + PATIENCE
        for child in self._children:
            try:
                child.wait(max(0.1, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.send_signal(signal.SIGKILL)
                child.wait()
        for _, said in self._children.values():
            said.close()
        self._children.clear()

    def processes(self) -> dict[int, Task]:
        """Process ids of what runs now."""
        return {child.pid: task for child, (task, _) in self._children.items()}


def worker_command(module: str, argv: Sequence[str]) -> list[str]:
    """The command line of a child that does a task and ends when this process does; see `worker`."""
    return [
        sys.executable,
        "-m",
        "visdom_plugin.tables.run.worker",
        "--parent",
        str(os.getpid()),
        module,
        *argv,
    ]


def environment(threads: int) -> Mapping[str, str]:
    """This process's environment with so many threads for every library that asks it."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    return os.environ | dict.fromkeys(names, str(threads))


def count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def read_all(said: IO[bytes]) -> str:
    """Everything that was written to a temporary file, which is closed."""
    with said:
        said.seek(0)
        return said.read().decode(errors="replace")
