"""Idle OpenMP threads are asked to sleep soon, unless the user says otherwise; freed memory is kept."""

import os
import subprocess
import sys

import pytest

from visdom_plugin.cli import entry


@pytest.mark.parametrize(
    ("given", "spins"),
    [({}, "2000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, None)],
    ids=["default", "user's count", "user's policy"],
)
def test_commands_let_idle_openmp_threads_sleep(given, spins, monkeypatch):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "environ", dict(os.environ) | given)
    entry.run(lambda argv: 0, [])
    assert os.environ.get("GOMP_SPINCOUNT") == spins


PROGRAM = """
import resource
import numpy as np
from visdom_plugin.cli import entry

def use():
    for array in [np.empty(1 << 20, np.uint8) for _ in range(16)]:
        array[:] = 1

def work(argv):
    use()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        use()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

entry.run(work, [])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems' C libraries have no such setting")
def test_commands_use_freed_memory_again():
    """Else every page of each 16 MiB would be mapped anew: 40,000 faults."""
    out = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True)
    assert int(out.stdout) < 1000
