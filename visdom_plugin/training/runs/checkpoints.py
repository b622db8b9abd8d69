"""States of a training run on disk: safetensors with a JSON beside it that vouches for it."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from torch import Tensor

from visdom_plugin.atomic_files import write_bytes, write_json
from visdom_plugin.errors import CheckpointError

Notes: TypeAlias = dict[str, Any]
"""JSON beside a state."""

KEPT = 2
"""The newest states are kept; the one before the last is there in case the last is damaged."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """A state read back."""

    step: int
    """Steps done: training goes on with this one."""
    tensors: dict[str, Tensor]
    """The method's state, on the CPU."""
    notes: Notes
    """What the trainer wants to remember besides, e.g. the seconds spent."""


def save(
    folder: Path, step: int, tensors: dict[str, Tensor], notes: Notes, *, kept: int | None = KEPT
) -> Path:
    """Writes the state after `step` steps and removes all but the newest `kept`; None keeps all.

    The JSON comes last: a state without it does not count. Returns the safetensors file.
    """
    from safetensors.torch import save as to_bytes

    # Copies, because safetensors refuses tensors that share memory.
    data = to_bytes({k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()})
    path = folder / f"step-{step:08d}.safetensors"
    write_bytes(path, data)
    digest = hashlib.sha256(data).hexdigest()
    write_json(path.with_suffix(".json"), {"step": step, "sha256": digest, "notes": notes})
    for old in list_steps(folder)[: -kept if kept else 0]:
        remove(folder, old)
    return path


def list_steps(folder: Path) -> list[int]:
    """Steps with a state that was completely written, ascending."""
    steps = []
    for path in folder.glob("step-*.json"):
        number = path.stem.removeprefix("step-")
        if number.isdecimal() and path.with_suffix(".safetensors").exists():
            steps.append(int(number))
    return sorted(steps)


def remove(folder: Path, step: int) -> None:
    """Removes one state, the JSON first so that no half of it counts."""
    for suffix in (".json", ".safetensors"):
        (folder / f"step-{step:08d}{suffix}").unlink(missing_ok=True)


def load(folder: Path, step: int) -> Checkpoint:
    """Reads one state.

    Raises:
        CheckpointError: when it is missing, damaged or contradicts its JSON.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    path = folder / f"step-{step:08d}.safetensors"
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != record["sha256"]:
            raise CheckpointError("the checkpoint's bytes are not the ones written", where=path)
        return Checkpoint(int(record["step"]), from_bytes(data), dict(record["notes"]))
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"the checkpoint cannot be read: {error}", where=path) from error


def load_newest(folder: Path) -> Checkpoint | None:
    """The newest state that is whole; damaged ones are skipped with a warning. None when there is none."""
    for step in reversed(list_steps(folder)):
        try:
            return load(folder, step)
        except CheckpointError as error:
            log.warning("%s\n  an older checkpoint is used, if there is one", error)
    return None
