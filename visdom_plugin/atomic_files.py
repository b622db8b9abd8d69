"""Atomic files: each is there whole, or not there."""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MARK = ".part-"
"""Prefix of files that are being written; what a killed process leaves behind carries it."""


@contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, with the same suffix, that becomes `path` when the block succeeds.

    The bytes reach the disk before the name does, so that a crash at any moment leaves the old file or
    the new one.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{MARK}{secrets.token_hex(4)}-{path.name}")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    finally:
        part.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file in one step."""
    with appearing(path) as part:
        part.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Writes plain data as JSON in one step; numbers that are not finite become null."""
    text = json.dumps(finite(value), indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def finite(value: Any) -> Any:
    """The same plain data with None for NaN and infinities, which JSON does not have."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def remove_parts(folder: Path) -> None:
    """Removes what a killed process left half-written, at any depth."""
    # With a second dot: writers that make a temporary file of their own beside the one they were given.
    for part in [*folder.rglob(f"{MARK}*"), *folder.rglob(f".{MARK}*")]:
        if part.is_dir() and not part.is_symlink():
            shutil.rmtree(part)
        else:
            part.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
