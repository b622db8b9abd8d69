"""torch's threads sleep between operations where a method of splats trains, and only there."""

import os
import sys

import pytest

from visdom_plugin.cli.commands.train import _share_cores
from visdom_plugin.registry import find


@pytest.mark.parametrize(
    "method, before, after",
    [("3dgs-go+vd", None, "passive"), ("3dgs-go", "active", "active"), ("ingp", None, None)],
)
def test_waiting_threads(method, before, after, monkeypatch):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if before is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", before)
    _share_cores(find(method).quick)
    assert os.environ.get("OMP_WAIT_POLICY") == after


def test_nothing_is_asked_where_torch_is_there_already(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    import torch  # noqa: F401

    _share_cores(find("3dgs-go").quick)
    assert "OMP_WAIT_POLICY" not in os.environ
