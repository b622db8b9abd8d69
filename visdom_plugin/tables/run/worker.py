"""The process of one job: `python -m visdom_plugin.tables.run.worker --parent PID MODULE ARGUMENTS...`.

Calls `MODULE.main(ARGUMENTS)`. On Linux it gets SIGTERM when the process that started it dies in whatever way,
upon which a training run saves its state and stops. Elsewhere it goes on to its end and holds its run directory
until then; a new driver waits for it.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module

_PR_SET_PDEATHSIG = 1
"""From linux/prctl.h."""


def die_with(parent: int) -> None:
    """Asks the kernel for SIGTERM at the parent's death, where it offers that."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent:
        # It died before the kernel was asked.
        sys.exit(128 + signal.SIGTERM)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; the exit status is that of the module's `main`."""
    words = list(sys.argv[1:] if argv is None else argv)
    if hasattr(signal, "SIGUSR2"):
        # A cluster announces the time limit with it.
        signal.signal(signal.SIGUSR2, lambda number, frame: signal.raise_signal(signal.SIGTERM))
    if words[0] == "--parent":
        die_with(int(words[1]))
        words = words[2:]
    return int(import_module(words[0]).main(words[1:]) or 0)


if __name__ == "__main__":
    sys.exit(main())
