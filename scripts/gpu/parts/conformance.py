"""`pytest --pyargs visdom_plugin.conformance` on the device: a method's promises, for each of those compared."""

from __future__ import annotations

import subjects
from bench import Bench, Case
from parts.tests import run_pytest


def cases(bench: Bench) -> list[Case]:
    found = []
    for name in subjects.METHODS:
        needs = () if name.startswith(("ingp", "zipnerf", "zerorf")) else ("gsplat",)
        found.append(Case(name, _conform(name), 90, needs))
    return bench.choose(found)


def _conform(name: str):
    def run(bench: Bench) -> dict:
        words = ["--pyargs", "visdom_plugin.conformance", "--method", name, "-k", str(bench.device)]
        return run_pytest(bench, f"conformance-{name}", words)

    return run
