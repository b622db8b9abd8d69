"""Settings of a process that calculates: how long idle threads spin, and what becomes of freed memory."""

from __future__ import annotations

import ctypes
import os
import sys

SPINS = "2000"
"""Some 10 us. GNU OpenMP's own 300,000 are about a millisecond, and that long kernels that start behind a torch
operation would share their cores with threads that only wait."""

KEPT = 1 << 30
"""Bytes of freed memory that wait for the next arrays."""

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


def wait_briefly() -> None:
    """Lets torch's threads sleep soon after each operation; without effect once torch is imported.

    What the user set in the environment stays.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


def keep_freed_memory() -> None:
    """Lets what a step frees serve the next one; without effect where the C library is not GNU's.

    By default large arrays come from the system and go back to it, which clears and maps every page of them
    anew at each step, one thread at a time.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_MMAP_THRESHOLD, KEPT)
            mallopt(_TRIM_THRESHOLD, KEPT)
