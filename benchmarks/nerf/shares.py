# ruff: noqa: E402
"""Where a training step of a radiance field spends its time: in kernels on all threads, in kernels on one, and in
the rest, which is operations of torch, Python and autograd.

    python benchmarks/nerf/shares.py --methods zipnerf-lite ingp+vd --threads 2

The steps are those of `step.py`, with the making of their batch. Times are medians of the last quarter of the
steps, each part without the parts it calls. Python between the kernels of one launch counts as kernels. Operations
of torch are counted in one step afterwards. A part's rest is serial.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import defaultdict
from types import FunctionType

from visdom_plugin.compute.process import keep_freed_memory, wait_briefly

wait_briefly()  # both before torch is imported, as the commands do
keep_freed_memory()

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.compute import parallel
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import build

PARTS = {
    "batch": "pixel_batch",
    "bounds of rays": "bound",
    "random numbers": "generator draw_on uniform draw_background",
    "sampling": "_take_samples sample_distances multisample contract middles_of",
    "hash grids": "encode encode_spread mean_square_per_level",
    "networks": "run_layers encode_harmonics encode_sinusoids density_of padded_sigmoid",
    "weights and compositing": "weights_from_density composite composite_packed",
    "field along rays, at once": "shade",
    "losses": "ray_losses mask_loss antialiased_interlevel_loss distortion_loss curve_distances photograph_on",
    "occupancy": "update",
    "backward, autograd": "backward",
    "optimiser": "optimise",
}
"""Functions and methods of visdom_plugin by part; the rest of a step is "glue"."""
GLUE = "glue"
KERNELS = ("rest", "kernels on one thread", "kernels on all threads")


class Clock:
    """Time by part and kind of work; what a part calls counts for the called part alone."""

    def __init__(self) -> None:
        self.spent: dict[tuple[str, str], float] = defaultdict(float)
        self.stack = [(GLUE, "rest")]
        self.since = time.perf_counter()

    def turn(self) -> None:
        now = time.perf_counter()
        self.spent[self.stack[-1]] += now - self.since
        self.since = now

    def within(self, function, part=None):
        """The function, timed as a part; as kernels of the part that launches them where there is none."""

        def timed(*arguments, **named):
            if part is None:
                _, grain, runs = arguments
                shared = sum(-(-count // grain) for count, _ in runs) > 1 < torch.get_num_threads()
                here = self.stack[-1][0], KERNELS[1 + shared]
            else:
                here = part, "rest"
            self.turn()
            self.stack.append(here)
            try:
                return function(*arguments, **named)
            finally:
                self.turn()
                self.stack.pop()

        return timed


class Count(TorchDispatchMode):
    """Operations of torch by part."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.seen = clock, defaultdict(int)

    def __torch_dispatch__(self, operation, types, arguments=(), named=None):
        self.seen[self.clock.stack[-1][0]] += 1
        return operation(*arguments, **(named or {}))


def watch(clock: Clock) -> None:
    """Puts the clock around all parts, wherever their functions have been imported."""
    names = {name: part for part, text in PARTS.items() for name in text.split()}
    modules = [m for name, m in list(sys.modules.items()) if name.startswith("visdom_plugin")]
    spaces = modules + [c for m in modules for c in vars(m).values() if isinstance(c, type)]
    launch = parallel.parallel_for_each  # by which `parallel_for` launches, too
    known: dict[object, object] = {launch: clock.within(launch)}
    for space in {id(space): space for space in spaces}.values():
        for name, value in list(vars(space).items()):
            if isinstance(space, type) and issubclass(space, torch.autograd.Function):
                if name == "backward":
                    timed = clock.within(value.__func__, f"backward of {space.__name__.strip('_')}")
                    setattr(space, name, staticmethod(timed))
            elif isinstance(value, FunctionType):
                if name in names and value not in known:
                    known[value] = clock.within(value, names[name])
                if value in known:
                    setattr(space, name, known[value])
    torch.Tensor.backward = clock.within(torch.Tensor.backward, names["backward"])


def measure(name: str, scene, clock: Clock, threads: int, steps: int, rays: int, budget: str) -> None:
    torch.set_num_threads(threads)
    preset = registry.find(name)
    method, _, _ = build(preset, getattr(preset, budget), scene.train, device=torch.device("cpu"), seed=0)
    data = DataManager(scene.train, seed=0)

    def step(i: int) -> None:
        output = method.train_step(data.pixel_batch(i, rays), i)
        output.total.backward()
        method.optimise(i, output)

    kept, totals = [], []
    for i in range(steps):
        clock.turn()
        clock.spent.clear()
        step(i)
        clock.turn()
        if i >= 3 * steps // 4:
            kept.append(dict(clock.spent))
            totals.append(sum(clock.spent.values()))
    with Count(clock) as count:
        step(steps)
    typical = statistics.median(totals)
    print(f"\n{name}, {threads} threads: {1e3 * typical:.2f} ms a step\n")
    print(f"| part | operations | {' | '.join(KERNELS)} |\n|" + " --- |" * 5)
    sums = [0.0] * 3
    for part in dict.fromkeys((*PARTS, *(part for part, _ in clock.spent))):
        times = [1e3 * statistics.median(s.get((part, kind), 0.0) for s in kept) for kind in KERNELS]
        if sum(times):
            print(f"| {part} | {count.seen[part]} | " + " | ".join(f"{t:.2f}" for t in times) + " |")
        sums = [a + b for a, b in zip(sums, times, strict=True)]
    print(f"| sum | {sum(count.seen.values())} | " + " | ".join(f"{t:.2f}" for t in sums) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--methods", nargs="+", default=["zipnerf-lite", "zipnerf-lite+vd", "ingp", "ingp+vd"]
    )
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, default=160)
    parser.add_argument("--rays", type=int, default=512)
    parser.add_argument("--budget", choices=["quick", "full"], default="quick")
    args = parser.parse_args()
    scene = make_scene(SyntheticConfig())
    for name in args.methods:
        registry.find(name)
    clock = Clock()
    # Methods import their modules when they are built.
    for name in {n.split("+")[0] for n in args.methods}:
        build(registry.find(name), registry.find(name).quick, scene.train, device=torch.device("cpu"), seed=0)
    watch(clock)
    for name in args.methods:
        for threads in args.threads:
            measure(name, scene, clock, threads, args.steps, args.rays, args.budget)


if __name__ == "__main__":
    main()
