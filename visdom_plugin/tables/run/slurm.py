"""Tasks on a Slurm cluster, submitted through submitit as job arrays.

Slurm's own accounting is not needed: a task leaves a file when it ends, and squeue tells which ones are still
queued or running. The table's folder must be visible on the nodes under the same path.

A driver may die at any moment, and others may work beside it, without a task being submitted twice: the name of a
batch is on disk before the batch is submitted (see tables.batches), and whoever submits looks there first.
"""

from __future__ import annotations

import logging
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visdom_plugin.atomic_files import write_json
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.run.executors import (
    PATIENCE,
    Ended,
    Executor,
    environment,
    read_all,
    worker_command,
)
from visdom_plugin.tables.run.job_files import beside, read_json
from visdom_plugin.tables.run.jobs import Task
from visdom_plugin.tables.run.slurm_notes import Batch, Notes, Place, SlurmError, find_places, look_up
from visdom_plugin.tables.spec import Settings, TableSpec
from visdom_plugin.training.runs.config_io import from_plain, read_mapping

ARRAY = 1000
"""Tasks per array: Slurm's default MaxArraySize is 1001."""
RUNNING = ("RUNNING", "COMPLETING")
"""States of jobs that have left the line."""
ABSENT = 3
"""A task that the queue does not list so many times in a row, and that left no word, is lost."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SlurmConfig:
    """What a job asks of the cluster; each task is one job."""

    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    gpus: int = 0
    """Per task."""
    cpus: int = 4
    """Per task; also its number of threads."""
    memory_gb: float | None = 16.0
    """Per task; None leaves it to the cluster."""
    time_min: int = 240
    """Limit per task. A training run that comes to it goes on in another job."""
    array_parallelism: int = 64
    """Tasks of an array at a time."""
    setup: tuple[str, ...] = ()
    """Shell commands before the task, e.g. "module load cuda"."""
    options: Settings | None = None
    """Further options of sbatch by their long names, e.g. {"reservation": "night"}."""
    poll_seconds: float = 10.0
    """Between two questions to the queue."""


def read_config(spec: TableSpec, file: Path | None) -> SlurmConfig:
    """Resources from a table's `slurm:` and from a YAML file, whose entries win.

    Raises:
        ConfigError: for unknown entries, with the valid ones.
    """
    config = from_plain(SlurmConfig(), spec.slurm, spec.source, "slurm")
    if file is None:
        return config
    return from_plain(config, read_mapping(file, "the file of Slurm's resources"), str(file))


class Slurm(Executor):
    """Submits tasks as arrays and watches them. They go on when the driver is stopped."""

    def __init__(self, config: SlurmConfig, folder: Path):
        """
        Args:
            folder: of the run directories; `slurm.json` says there what any table submitted, `slurm/` holds
                submitit's files.

        Raises:
            ConfigError: when submitit or Slurm's commands are not installed.
        """
        try:
            import submitit  # noqa: F401
        except ImportError:
            raise ConfigError(
                "the executor slurm needs submitit",
                todo="pip install 'visdom-plugin[slurm]'",
                topic="not-installed",
            ) from None
        missing = [name for name in ("sbatch", "squeue", "srun") if shutil.which(name) is None]
        if missing:
            raise ConfigError(
                f"the executor slurm needs Slurm's commands; not found: {', '.join(missing)}",
                todo="run it on a login node of the cluster, or with --executor local",
                topic="not-installed",
            )
        self.config, self.folder = config, Path(folder).resolve()
        self.pause = min(2.0, config.poll_seconds)
        self._notes = Notes(self.folder)
        self._active: dict[Path, tuple[Task, Place]] = {}
        """By run directory."""
        self._running: set[Path] = set()
        self._absent: dict[Path, int] = {}
        self._asked = 0.0

    def free(self) -> int:
        return 10 * ARRAY

    def adopt(self, tasks: Sequence[Task]) -> list[Task]:
        """Tasks that another driver submitted and that are queued, running, or ended with a word."""
        batches = self._notes.read()
        places, queue = find_places(batches), look_up(batches)
        for task in tasks:
            place = places.get(task.run_dir.name)
            if place is not None and (place in queue or _read_word(task, place) is not None):
                self._active[task.run_dir] = task, place
        self._note_running(queue)
        self._forget_ended()
        if self._active:
            log.info("%d runs are on the cluster already", len(self._active))
        return [task for task, _ in self._active.values()]

    def start(self, tasks: Sequence[Task]) -> None:
        """Submits tasks as arrays, and adopts those that another driver submitted in the meantime.

        Raises:
            SlurmError: when sbatch refuses.
        """
        for begin in range(0, len(tasks), ARRAY):
            self._submit(list(tasks[begin : begin + ARRAY]))

    def queued(self) -> Collection[Path]:
        return self._active.keys() - self._running

    def poll(self) -> list[Ended]:
        ended = []
        for run_dir, (task, place) in self._active.items():
            word = _read_word(task, place)
            if word is not None:
                ended.append(Ended(task, int(word["code"]), str(word.get("said", ""))))
                self._absent.pop(run_dir, None)
        for end in ended:
            del self._active[end.task.run_dir]
        if self._active and time.monotonic() - self._asked >= self.config.poll_seconds:
            ended += [Ended(task, None) for task in self._find_lost()]
        if ended:
            self._forget_ended()
        return ended

    def stop(self) -> None:
        """Leaves the jobs to the cluster and says so."""
        if self._active:
            names = ",".join(sorted({name for _, (name, _) in self._active.values()}))
            log.warning(
                "%d runs stay on the cluster; repeat the command to follow them, `scancel --name=%s` cancels them",
                len(self._active),
                names,
            )

    def _submit(self, tasks: list[Task]) -> None:
        import submitit

        name = f"visdom-{secrets.token_hex(4)}"
        with self._notes.changing() as batches:
            tasks = self._leave_out_submitted(tasks, batches)
            if not tasks:
                return
            note: Batch = {"id": None, "time": time.time(), "runs": [task.run_dir.name for task in tasks]}
            batches[name] = note
        c = self.config
        wanted = {
            "slurm_job_name": name,
            "timeout_min": c.time_min,
            "cpus_per_task": c.cpus,
            "nodes": 1,
            "tasks_per_node": 1,
            "slurm_array_parallelism": c.array_parallelism,
            "mem_gb": c.memory_gb,
            "gpus_per_node": c.gpus or None,
            "slurm_partition": c.partition,
            "slurm_account": c.account,
            "slurm_qos": c.qos,
            "slurm_constraint": c.constraint,
            "slurm_setup": list(c.setup) or None,
            "slurm_additional_parameters": c.options,
        }
        # With several Slurm clusters or none at hand submitit would choose by itself.
        executor = submitit.AutoExecutor(folder=self.folder / "slurm", cluster="slurm")
        executor.update_parameters(**{k: v for k, v in wanted.items() if v is not None})
        count = len(tasks)
        try:
            jobs = executor.map_array(
                run_task,
                [task.module for task in tasks],
                [list(task.argv) for task in tasks],
                [str(task.run_dir) for task in tasks],
                [name] * count,
                [c.cpus] * count,
            )
        except Exception as error:
            if type(error).__name__ != "FailedJobError":
                raise
            with self._notes.changing() as batches:
                batches.pop(name, None)
            raise SlurmError(
                f"the cluster refuses the jobs: {error}",
                where=f"{len(tasks)} tasks, {c}",
                todo="change the resources in the table's `slurm:` or with --slurm FILE",
            ) from error
        with self._notes.changing() as batches:
            batches[name] = {**note, "id": str(jobs[0].job_id).partition("_")[0]}
        for index, task in enumerate(tasks):
            self._active[task.run_dir] = task, (name, index)

    def _leave_out_submitted(self, tasks: Sequence[Task], batches: Mapping[str, Batch]) -> list[Task]:
        """The tasks that are not on the cluster; the others are watched like those of this driver."""
        places = find_places(batches)
        noted = {places[task.run_dir.name][0] for task in tasks if task.run_dir.name in places}
        queue = look_up({name: batches[name] for name in noted})
        left = []
        for task in tasks:
            place = places.get(task.run_dir.name)
            # A job that left its word is over, though the queue may list it for a while.
            if place in queue and _read_word(task, place) is None:
                self._active[task.run_dir] = task, place
            else:
                left.append(task)
        return left

    def _find_lost(self) -> list[Task]:
        """Asks the queue. Tasks that it did not list ABSENT times in a row; they are no longer watched."""
        self._asked = time.monotonic()
        notes = self._notes.read()
        # Another driver may have removed the note, and the jobs be in the queue yet.
        gone: Batch = {"id": None, "time": 0.0, "runs": []}
        queue = look_up({name: notes.get(name, gone) for _, (name, _) in self._active.values()})
        self._note_running(queue)
        lost = []
        for run_dir, (task, place) in list(self._active.items()):
            self._absent[run_dir] = 0 if place in queue else self._absent.get(run_dir, 0) + 1
            if self._absent[run_dir] >= ABSENT:
                del self._active[run_dir], self._absent[run_dir]
                lost.append(task)
        return lost

    def _note_running(self, queue: Mapping[Place, str]) -> None:
        self._running = {d for d, (_, place) in self._active.items() if queue.get(place) in RUNNING}

    def _forget_ended(self) -> None:
        """Removes batches from the notes of which nothing is left on the cluster."""
        watched = {name for _, (name, _) in self._active.values()}
        others = {name: batch for name, batch in self._notes.read().items() if name not in watched}
        ended = others.keys() - {name for name, _ in look_up(others)}
        if ended:
            with self._notes.changing() as batches:
                for name in ended:
                    batches.pop(name, None)


def _read_word(task: Task, place: Place) -> dict[str, Any] | None:
    """What a task that ran there left when it ended."""
    word = read_json(beside(task.run_dir, ".exit.json"))
    return word if word is not None and word.get("batch") == place[0] else None


def run_task(module: str, argv: list[str], run_dir: str, batch: str, cpus: int) -> int:
    """Runs on the node: the task in a process of its own, and a word on how it ended."""
    path = Path(run_dir)
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(
            worker_command(module, argv), stdin=subprocess.DEVNULL, stderr=said, env=environment(cpus)
        )
        try:
            code = child.wait()
        except BaseException:
            # The time limit: submitit raises. The run saves its state; another job goes on with it.
            child.send_signal(signal.SIGTERM)
            child.wait(PATIENCE)
            raise
        word = {"batch": batch, "code": code, "said": read_all(said)}
    write_json(beside(path, ".exit.json"), word)
    return code
