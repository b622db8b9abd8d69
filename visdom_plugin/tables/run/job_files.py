"""Files of a job, in its run directory and beside it: outcome, error, log, lock. Never waits.

runs/<name>/            the run directory of the job's command
runs/<name>.yaml        its settings, for --config
runs/<name>.log         what the command said on stderr, once it ended
runs/<name>.error.json  why it failed: only of jobs that did
runs/<name>.exit.json   how the command ended on a cluster
"""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from visdom_plugin.atomic_files import MARK, write_bytes, write_json
from visdom_plugin.tables.results import Outcome

BUSY = "another process is training into this run directory"
"""What a command says that finds its run directory held by a living process."""


def beside(run_dir: Path, suffix: str) -> Path:
    """A file of the job next to its run directory, e.g. suffix ".yaml"."""
    return run_dir.with_name(run_dir.name + suffix)


def read_json(path: Path) -> dict[str, Any] | None:
    """A JSON object, or None where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def read_outcome(run_dir: Path) -> Outcome:
    """What is known of a job: finished, failed or, for all else, waiting."""
    record = read_json(run_dir / "run.json")
    if record is not None and record.get("status") == "finished":
        return Outcome("finished", record=record)
    error = read_json(beside(run_dir, ".error.json"))
    if error is not None:
        return Outcome("failed", error=str(error.get("error", "no reason was noted")))
    if record is not None and record.get("status") == "failed":
        return Outcome("failed", error=str(record.get("error", f"see {run_dir / 'run.json'}")))
    return Outcome("waiting")


def note_error(run_dir: Path, error: str) -> None:
    """Keeps a failure for later runs of the table, and for the table itself."""
    write_json(beside(run_dir, ".error.json"), {"error": error})


def keep_log(run_dir: Path, said: str) -> None:
    """Keeps what the command said on stderr."""
    write_bytes(beside(run_dir, ".log"), said.encode())


def has_error(run_dir: Path) -> bool:
    """Whether a failure was noted."""
    return beside(run_dir, ".error.json").exists()


def forget_error(run_dir: Path) -> None:
    """Lets a failed job be tried again."""
    for suffix in (".error.json", ".exit.json"):
        beside(run_dir, suffix).unlink(missing_ok=True)


def read_step(run_dir: Path) -> int:
    """The newest step that the run's log or checkpoints tell of; 0 before the first."""
    steps = [0]
    try:
        with (run_dir / "log.jsonl").open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - 2000))
            for line in file.read().decode(errors="replace").splitlines():
                try:
                    steps.append(int(json.loads(line)["step"]))
                except (ValueError, KeyError, TypeError):
                    continue
    except OSError:
        pass
    for path in (run_dir / "checkpoints").glob("step-*.json"):
        number = path.stem.removeprefix("step-")
        if number.isdecimal():
            steps.append(int(number))
    return max(steps)


def is_held(run_dir: Path) -> bool:
    """Whether a living process of this machine writes to the run directory.

    The question holds the lock for an instant, so it is asked before a job is started, not while it runs.
    """
    if os.name != "posix":
        return False
    import fcntl

    try:
        with (run_dir / "run.lock").open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def remove_old_parts(folder: Path, seconds: float = 600) -> None:
    """Removes what a killed driver left half-written in a folder; what is younger may be another driver's."""
    for part in folder.glob(f"{MARK}*"):
        with suppress(OSError):
            if time.time() - part.stat().st_mtime > seconds:
                part.unlink()


def explain_exit(code: int, said: str) -> str:
    """Why a command failed, from its exit status (negative for a signal) and what it wrote on stderr."""
    import signal

    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        hint = ", perhaps for lack of memory" if name == "SIGKILL" else ""
        return f"the process was killed by another one ({name}{hint})"
    lines = said.strip().splitlines()
    starts = [i for i, line in enumerate(lines) if line.startswith("error: ")]
    if starts:
        return "\n".join(lines[starts[-1] :]).removeprefix("error: ")
    spoken = [line for line in lines if line.strip()]
    return spoken[-1].strip() if spoken else f"the process ended with status {code} and said nothing"
