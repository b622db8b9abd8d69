"""How long torch's idle OpenMP threads keep a core busy."""

from __future__ import annotations

import os

SPINS = "2000"
"""Some 10 us. GNU OpenMP's own 300,000 are about a millisecond, and that long kernels that start behind a torch
operation would share their cores with threads that only wait."""


def wait_briefly() -> None:
    """Lets torch's threads sleep soon after each operation; without effect once torch is imported.

    What the user set in the environment stays.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
