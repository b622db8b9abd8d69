"""300 steps of every method, bare and in the visible domain, at its small size on the built-in scene: mean PSNR
of the test views beside the CPU's, and how long a step takes."""

from __future__ import annotations

import statistics
import time

import project
import subjects
from bench import Bench, Case, Disagrees

ALLOWED_DB = 0.5
"""Runs of one method differ by about this much from seed to seed."""


def cases(bench: Bench) -> list[Case]:
    found = []
    for name in subjects.VARIANTS:
        needs = () if name.startswith(("ingp", "zipnerf", "zerorf")) else ("gsplat",)
        found.append(Case(name, _train(name), 60 if bench.on_cuda else 600, needs))
    return bench.choose(found)


def _train(name: str):
    def run(bench: Bench) -> dict:
        scene = subjects.built_in(bench.size(200, 40))
        steps = bench.size(300, 4)
        bench.reset_peak()
        method, batches, _ = subjects.start(bench, name, scene, bench.device, steps=steps)
        spent = []
        for step in range(steps):
            bench.synchronise()
            began = time.perf_counter()
            subjects.step_once(method, batches, step)
            bench.synchronise()
            spent.append(1000 * (time.perf_counter() - began))
        test = project.evaluate(method, scene.test, reference_hull=None, device=bench.device)["test"]
        values = {
            "steps": steps,
            "ms a step": statistics.median(spent[steps // 2 :]),
            "PSNR": test["psnr"],
            "IoU": test["silhouette_iou"],
            "peak MB": bench.peak_mb(),
        }
        wanted = bench.references("train").get(name, {})
        if wanted.get("steps") != steps or not bench.on_cuda:
            return values
        values["CPU's PSNR"] = wanted["PSNR"]
        if not abs(test["psnr"] - wanted["PSNR"]) <= ALLOWED_DB:
            raise Disagrees(f"PSNR differs by {test['psnr'] - wanted['PSNR']:+.2f} dB", values)
        return values

    return run
