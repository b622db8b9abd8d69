"""Tasks on a Slurm cluster, submitted through submitit as job arrays.

Slurm's own accounting is not needed: a task leaves a file when it ends, and squeue tells which ones are still
queued or running. The table's folder must be visible on the nodes under the same path.

A driver may die at any moment without a task being submitted twice: the name of a batch is on disk before the
batch is submitted, and a new driver asks the cluster for the jobs of that name.
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visdom_plugin.errors import ConfigError, VisDomError
from visdom_plugin.tables.executors import PATIENCE, Ended, environment, read_log
from visdom_plugin.tables.jobs import Task
from visdom_plugin.tables.spec import TableSpec
from visdom_plugin.tables.state import beside, read_json
from visdom_plugin.training.files import write_json
from visdom_plugin.training.settings import from_plain

ARRAY = 1000
"""Tasks per array: Slurm's default MaxArraySize is 1001."""
SUBMITTING = 15.0
"""Seconds after which a batch that was about to be submitted is in the queue, or will never be."""
ABSENT = 3
"""A task that the queue does not list so many times in a row, and that left no word, is lost."""

log = logging.getLogger(__name__)


class SlurmError(VisDomError):
    """The cluster cannot be asked, or refuses a job."""


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
    options: dict[str, Any] | None = None
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
    import yaml

    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"the file of Slurm's resources cannot be read: {error}", where=file) from error
    return from_plain(config, content or {}, str(file))


class Slurm:
    """Submits tasks as arrays and watches them. They go on when the driver is stopped."""

    lasting = True

    def __init__(self, config: SlurmConfig, folder: Path):
        """
        Args:
            folder: of the table; `slurm.json` says there what was submitted, `slurm/` holds submitit's files.

        Raises:
            ConfigError: when submitit or Slurm's commands are not installed.
        """
        try:
            import submitit  # noqa: F401
        except ImportError:
            raise ConfigError(
                "the executor slurm needs submitit", todo="pip install 'visdom-plugin[slurm]'"
            ) from None
        missing = [name for name in ("sbatch", "squeue", "srun") if shutil.which(name) is None]
        if missing:
            raise ConfigError(
                f"the executor slurm needs Slurm's commands; not found: {', '.join(missing)}",
                todo="run it on a login node of the cluster, or with --executor local",
            )
        self.config, self.folder = config, Path(folder).resolve()
        self.pause = min(2.0, config.poll_seconds)
        self._notes = self.folder / "slurm.json"
        self._active: dict[Path, tuple[Task, str, int]] = {}
        """Run directory to task, batch name, position in the batch."""
        self._absent: dict[Path, int] = {}
        self._asked = 0.0

    def free(self) -> int:
        return 10 * ARRAY

    def adopt(self, tasks: Sequence[Task]) -> list[Task]:
        """Tasks that an earlier driver submitted and that are queued, running, or ended with a word."""
        wanted = {task.run_dir.name: task for task in tasks}
        batches = self._read_notes()
        for name, batch in batches.items():
            alive = self._alive([name])
            while batch.get("id") is None and not alive and time.time() - batch.get("time", 0) < SUBMITTING:
                time.sleep(1)
                alive = self._alive([name])
            for index, run in enumerate(batch["runs"]):
                if run in wanted and ((name, index) in alive or self._word(wanted[run], name) is not None):
                    self._active[wanted[run].run_dir] = (wanted[run], name, index)
        self._forget_ended()
        if self._active:
            log.info("%d runs are on the cluster already", len(self._active))
        return [task for task, _, _ in self._active.values()]

    def start(self, tasks: Sequence[Task]) -> None:
        """Submits tasks as arrays.

        Raises:
            SlurmError: when sbatch refuses.
        """
        for begin in range(0, len(tasks), ARRAY):
            self._submit(list(tasks[begin : begin + ARRAY]))

    def poll(self) -> list[Ended]:
        ended = []
        for run_dir, (task, name, _) in list(self._active.items()):
            code = self._word(task, name)
            if code is not None:
                ended.append(Ended(task, code, read_log(run_dir)))
        if time.monotonic() - self._asked >= self.config.poll_seconds and len(ended) < len(self._active):
            self._asked = time.monotonic()
            alive = self._alive(sorted({name for _, name, _ in self._active.values()}))
            gone = {e.task.run_dir for e in ended}
            for run_dir, (task, name, index) in self._active.items():
                there = (name, index) in alive
                self._absent[run_dir] = 0 if there else self._absent.get(run_dir, 0) + 1
                if run_dir not in gone and self._absent[run_dir] >= ABSENT:
                    ended.append(Ended(task, None, read_log(run_dir)))
        for end in ended:
            del self._active[end.task.run_dir]
            self._absent.pop(end.task.run_dir, None)
        if ended:
            self._forget_ended()
        return ended

    def stop(self) -> None:
        """Leaves the jobs to the cluster and says so."""
        if self._active:
            names = ",".join(sorted({name for _, name, _ in self._active.values()}))
            log.warning(
                "%d runs stay on the cluster; the same command finds them again, `scancel --name=%s` ends them",
                len(self._active),
                names,
            )

    def _submit(self, tasks: list[Task]) -> None:
        import submitit

        name = f"visdom-{secrets.token_hex(4)}"
        batches = self._read_notes()
        batches[name] = {"id": None, "time": time.time(), "runs": [task.run_dir.name for task in tasks]}
        write_json(self._notes, {"batches": batches})
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
            batches.pop(name)
            write_json(self._notes, {"batches": batches})
            raise SlurmError(
                f"the cluster refuses the jobs: {error}",
                where=f"{len(tasks)} tasks, {c}",
                todo="change the resources in the table's `slurm:` or with --slurm FILE",
            ) from error
        batches[name]["id"] = str(jobs[0].job_id).partition("_")[0]
        write_json(self._notes, {"batches": batches})
        for index, task in enumerate(tasks):
            self._active[task.run_dir] = (task, name, index)

    def _alive(self, names: Sequence[str]) -> set[tuple[str, int]]:
        """Batch names and positions of the jobs that the queue lists."""
        if not names:
            return set()
        command = ["squeue", "--noheader", "--array", f"--name={','.join(names)}", "--format=%j|%K|%T"]
        for attempt in range(3):
            try:
                said = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
                break
            except (subprocess.SubprocessError, OSError) as error:
                if attempt == 2:
                    reason = getattr(error, "stderr", None) or error
                    raise SlurmError(f"the cluster's queue cannot be read: {str(reason).strip()}") from error
                time.sleep(2)
        alive = set()
        for line in said.splitlines():
            name, index, state = line.strip().split("|")
            if state not in ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY"):
                # A batch of one is no array.
                alive.add((name, int(index) if index.isdecimal() else 0))
        return alive

    def _word(self, task: Task, batch: str) -> int | None:
        """The exit status that a task of this batch left."""
        word = read_json(beside(task.run_dir, ".exit.json"))
        return int(word["code"]) if word is not None and word.get("batch") == batch else None

    def _read_notes(self) -> dict[str, Any]:
        return dict((read_json(self._notes) or {}).get("batches") or {})

    def _forget_ended(self) -> None:
        """Removes batches from the notes of which nothing is left on the cluster."""
        batches = self._read_notes()
        names = {name for _, name, _ in self._active.values()}
        alive = {name for name, _ in self._alive([name for name in batches if name not in names])}
        kept = {name: batch for name, batch in batches.items() if name in names | alive}
        if kept != batches:
            write_json(self._notes, {"batches": kept})


def run_task(module: str, argv: list[str], run_dir: str, batch: str, cpus: int) -> int:
    """Runs on the node: the task in a process of its own, and a word on how it ended."""
    path = Path(run_dir)
    with beside(path, ".log").open("wb") as said:
        child = subprocess.Popen(
            [sys.executable, "-m", "visdom_plugin.tables.child", "--parent", str(os.getpid()), module, *argv],
            stdin=subprocess.DEVNULL,
            stderr=said,
            env=environment(cpus),
        )
        try:
            code = child.wait()
        except BaseException:
            # The time limit: submitit raises. The run saves its state; another job goes on with it.
            child.send_signal(signal.SIGTERM)
            child.wait(PATIENCE)
            raise
    write_json(beside(path, ".exit.json"), {"batch": batch, "code": code})
    return code
