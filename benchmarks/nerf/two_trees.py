"""Steps and views of the radiance fields in two trees of this project, in turns: old, new, old, new.

    git worktree add ../old ecba5d5
    python benchmarks/nerf/two_trees.py ../old . [--rounds 2]

Each variant is trained by itself with the preset of budget quick, 512 rays a step. The table has the median of
steps 30 to 60, where `ingp` still has many samples, and the fastest of three views of 200 x 200.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

METHODS = ("zipnerf-lite", "zipnerf-lite+vd", "ingp", "ingp+vd")
RAYS, FIRST, LAST = 512, 30, 60


def prepare_process() -> None:
    """Does what the tree's commands do before torch is imported; trees before 7ed982d do nothing."""
    for module in ("process", "openmp"):
        try:
            found = importlib.import_module(f"visdom_plugin.compute.{module}")
        except ImportError:
            continue
        for name in ("wait_briefly", "keep_freed_memory"):
            getattr(found, name, lambda: None)()


def measure() -> dict[str, tuple[float, float]]:
    """Milliseconds of a step and seconds of a view, of each of METHODS in the tree that is imported."""
    prepare_process()
    import torch

    from datamodules.synthetic.config import SyntheticConfig
    from datamodules.synthetic.scene import make_scene
    from visdom_plugin import registry
    from visdom_plugin.training.batches import DataManager
    from visdom_plugin.training.run import build

    scene, found = make_scene(SyntheticConfig()), {}
    data = DataManager(scene.train, seed=0)
    for name in METHODS:
        config = registry.find(name).quick
        method, _, _ = build(registry.find(name), config, scene.train, device=torch.device("cpu"), seed=0)
        steps, views = [], []
        for step in range(LAST):
            batch = data.pixel_batch(step, RAYS)
            began = time.perf_counter()
            output = method.train_step(batch, step)
            output.total.backward()
            method.optimise(step, output)
            steps.append(time.perf_counter() - began)
        for camera in (scene.test.cameras[i] for i in range(3)):
            began = time.perf_counter()
            method.render(camera, torch.ones(3))
            views.append(time.perf_counter() - began)
        found[name] = 1000 * statistics.median(steps[FIRST:]), min(views)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path, nargs="?")
    parser.add_argument("new", type=Path, nargs="?")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure()))
        return
    if args.new is None:
        parser.error("name two trees, such as ../old and .")
    rounds = []
    for tree in [args.old, args.new] * args.rounds:
        command = [sys.executable, __file__, "--measure"]
        here = os.environ | {"PYTHONPATH": str(tree.resolve())}
        said = subprocess.run(command, cwd=tree, env=here, capture_output=True, text=True, check=True).stdout
        rounds.append(json.loads(said.splitlines()[-1]))
    print("| | old step ms | new step ms | old view s | new view s |\n|" + " --- |" * 5)
    for name in METHODS:
        cells = [
            ", ".join(f"{one[name][which]:.{1 + which}f}" for one in rounds[tree::2])
            for which in (0, 1)
            for tree in (0, 1)
        ]
        print(f"| `{name}` | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
