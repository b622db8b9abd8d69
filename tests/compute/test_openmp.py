"""Idle OpenMP threads: asked to sleep soon, unless the user says otherwise."""

import os

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
