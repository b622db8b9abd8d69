"""Notes on what drivers submitted to a Slurm cluster, and the cluster's queue.

slurm.json  {"batches": {name: {"id": of the array, "time": of the note, "runs": names of run directories}}}
slurm.lock  held while slurm.json is read, changed and written

A batch is noted, without an id, before it is submitted, so that nothing is submitted unknown to other drivers.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

from visdom_plugin.atomic_files import write_json
from visdom_plugin.errors import VisDomError
from visdom_plugin.tables.run.job_files import read_json

SUBMITTING = 15.0
"""Seconds after which a batch that was about to be submitted is in the queue, or will never be."""
ENDED = ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY")
"""States of jobs that are over although squeue lists them for a while."""

Place = tuple[str, int]
"""The name of a batch and a position in it."""


class Batch(TypedDict):
    """What slurm.json holds of a batch."""

    id: str | None
    """Of the array; None until Slurm has named it."""
    time: float
    """Of the note, in seconds since 1970."""
    runs: list[str]
    """Names of run directories."""


class SlurmError(VisDomError):
    """The cluster cannot be asked, or refuses a job."""


class Notes:
    """The batches noted in a folder: name to what slurm.json holds of it, oldest first."""

    def __init__(self, folder: Path):
        self.folder = folder

    def read(self) -> dict[str, Batch]:
        """All batches; none where nothing is noted."""
        return dict((read_json(self.folder / "slurm.json") or {}).get("batches") or {})

    @contextmanager
    def changing(self) -> Iterator[dict[str, Batch]]:
        """The batches, to be changed in place; nobody else changes them until the block is left."""
        import fcntl

        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "slurm.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            batches = self.read()
            yield batches
            write_json(self.folder / "slurm.json", {"batches": batches})


def find_places(batches: Mapping[str, Batch]) -> dict[str, Place]:
    """Names of run directories to where they were submitted last."""
    return {run: (name, index) for name, batch in batches.items() for index, run in enumerate(batch["runs"])}


def look_up(batches: Mapping[str, Batch]) -> dict[Place, str]:
    """The batches' jobs that are in the queue or about to be, with their states."""
    queue = read_queue(list(batches))
    arrived = {name for name, _ in queue}
    for name, batch in batches.items():
        young = time.time() - batch["time"] < SUBMITTING
        if young and batch["id"] is None and name not in arrived:
            queue |= {(name, index): "SUBMITTING" for index in range(len(batch["runs"]))}
    return queue


def read_queue(names: Sequence[str]) -> dict[Place, str]:
    """The batches' jobs that squeue lists, with their states.

    Raises:
        SlurmError: when it does not answer.
    """
    if not names:
        return {}
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
    queue = {}
    for line in said.splitlines():
        name, index, state = line.strip().split("|")
        if state not in ENDED:
            # A batch of one is no array.
            queue[name, int(index) if index.isdecimal() else 0] = state
    return queue
