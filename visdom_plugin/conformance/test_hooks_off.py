"""A hook that is off leaves the method as it was, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from visdom_plugin.conformance.report import require
from visdom_plugin.conformance.subject import difference
from visdom_plugin.training.protocols import Method

TODO = "do for the visible domain only what the objects in `hooks` say"


def test_the_hook_switched_off_is_the_bare_method(hooked):
    if hooked.bare is None:
        pytest.skip(f"{hooked.name} has no variant without a hook")
    n = hooked.short
    found = hooked.run(hooked.start(hooked.switch_off()), 0, n).states[n]
    changed = difference(hooked.trained_bare.states[n], found)
    require(
        not changed,
        f"with the settings of the hook and its hull but the hook off, {n} steps lead elsewhere than those of the "
        f"bare method: {changed}",
        Method,
        TODO + "; a hull that comes without them is not to be used",
    )


def test_the_hook_enabled_but_not_there_is_the_hook_switched_off(hooked):
    n, config = hooked.short, hooked.config
    off = replace(config, vd=replace(config.vd, enabled=False))
    without = hooked.run(hooked.start(config, hooks=[]), 0, n).states[n]
    changed = difference(hooked.run(hooked.start(off), 0, n).states[n], without)
    require(
        not changed,
        f"with setup(hooks=[]), {n} steps depend on config.vd.enabled: {changed}",
        Method.setup,
        TODO + ", and do not read config.vd.enabled",
    )
