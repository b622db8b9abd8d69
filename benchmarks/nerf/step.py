# ruff: noqa: E402
"""A training step of each radiance field with the sampler against the same without, pairwise in one run.

    python benchmarks/nerf/step.py --method ingp --steps 200

Both have the same number of rays per step. Two settings: "same spacing" leaves all else equal, so that samples
lie as close in both and the shorter interval holds fewer; "preset" is what `+vd` and the bare variant train with.
Steps of the two alternate, so that a disturbance meets both. Also the time of one 200 x 200 test view.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace

from visdom_plugin.compute.process import keep_freed_memory, wait_briefly

wait_briefly()  # both before torch is imported, as the commands do
keep_freed_memory()

import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import build


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="+", default=["ingp", "zipnerf-lite"])
    parser.add_argument("--steps", type=int, default=200, help="timed are those of the last quarter")
    parser.add_argument("--rays", type=int, default=512)
    args = parser.parse_args()
    scene = make_scene(SyntheticConfig())
    data = DataManager(scene.train, seed=0)
    print("| method | setting | bare ms | +vd ms | +vd / bare | bare view s | +vd view s |\n|" + " --- |" * 7)
    for method in args.methods:
        for setting in ("same spacing", "preset"):
            bare, vd = registry.find(method).quick, registry.find(f"{method}+vd").quick
            if setting == "same spacing":
                vd = equal_spacing(bare, vd)
            pair = [start(method, bare, scene), start(f"{method}+vd", vd, scene)]
            times = [[], []]
            for step in range(args.steps):
                batch = data.pixel_batch(step, args.rays)
                for one, spent in zip(pair, times, strict=True):
                    began = time.perf_counter()
                    output = one.train_step(batch, step)
                    output.total.backward()
                    one.optimise(step, output)
                    spent.append(time.perf_counter() - began)
            last = [1000 * statistics.median(spent[3 * args.steps // 4 :]) for spent in times]
            views = [view_seconds(one, scene) for one in pair]
            print(
                f"| {method} | {setting} | {last[0]:.1f} | {last[1]:.1f} | {last[1] / last[0]:.2f} "
                f"| {views[0]:.2f} | {views[1]:.2f} |",
                flush=True,
            )


def equal_spacing(bare, vd):
    """+vd with the bare variant's distance between samples; its interval is about a fifth as long."""
    if hasattr(bare, "samples"):
        return replace(vd, samples=tuple(max(2, -(-n // 4)) for n in bare.samples))
    return replace(vd, step_length=bare.step_length, missing_step_length=bare.step_length)


def start(name: str, config, scene):
    method, _, _ = build(registry.find(name), config, scene.train, device=torch.device("cpu"), seed=0)
    return method


def view_seconds(method, scene) -> float:
    spent = []
    for i in range(3):
        began = time.perf_counter()
        method.render(scene.test.cameras[i], torch.ones(3))
        spent.append(time.perf_counter() - began)
    return min(spent)


if __name__ == "__main__":
    main()
