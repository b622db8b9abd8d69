"""The recipe visdom-gs: the paper's method with switches on, each of which can be turned off."""

from dataclasses import fields

import pytest

from method_configs import gs_go
from method_configs.visdom_gs import SPEC
from visdom_plugin.training.runs.config_io import as_plain, from_plain

PAPER, OURS = gs_go.SPEC.presets()["3dgs-go+vd"], SPEC.presets()["visdom-gs"]


@pytest.mark.parametrize("budget", ["quick", "full"])
def test_with_its_switches_turned_off_it_is_the_papers_method(budget):
    ours, paper = getattr(OURS, budget), getattr(PAPER, budget)
    switches = [f.name for f in fields(ours) if getattr(ours, f.name) != getattr(paper, f.name)]
    assert "initial_shape" in switches
    off = {name: as_plain(getattr(paper, name)) for name in switches}
    assert from_plain(ours, off, "the test") == paper


def test_it_is_one_method_with_the_hook_on():
    assert list(SPEC.presets()) == ["visdom-gs"]
    assert OURS.hook == "gaussian" and OURS.quick.vd.enabled and OURS.full.vd.enabled
