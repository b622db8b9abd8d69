"""Claims on work that one of several processes does for all.

A claim is a lock on one byte of a file, which the system drops with the process that holds it. Where there are
no such locks (Windows, some network drives) every claim is granted, and work may be done twice.
"""

from __future__ import annotations

import os
import zlib
from functools import cache
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

FILE = "claims.lock"


@cache
def _open(folder: Path, process: int) -> int | None:
    # Opened once in a process: closing any handle of a file drops all its locks.
    try:
        return os.open(folder / FILE, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
    except OSError:
        return None


class Claim:
    """The claim on something by its name, among the processes that name the same folder."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._byte = folder, zlib.crc32(name.encode())

    def take(self) -> bool:
        """False where another process has it."""
        handle = _open(self._folder, os.getpid())
        if fcntl is None or handle is None:
            return True
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._byte)
        except (BlockingIOError, PermissionError):
            return False
        except OSError:
            return True
        return True

    def drop(self) -> None:
        """Lets the others have it; nothing happens where it was not taken."""
        handle = _open(self._folder, os.getpid())
        if fcntl is not None and handle is not None:
            try:
                fcntl.lockf(handle, fcntl.LOCK_UN, 1, self._byte)
            except OSError:
                return
