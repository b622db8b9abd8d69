# ruff: noqa: E402
"""What of a training step of Gaussians runs on all threads, kernel by kernel, and what on one.

    python benchmarks/splat/shares.py [--threads 1 2] [--sizes 20000x200]

The steps are those of `step.py`. The rest is Python, autograd, operations of torch and prefix sums. Times are the
least of the repeats.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import defaultdict

from visdom_plugin.compute.process import keep_freed_memory, wait_briefly

wait_briefly()  # both before torch is imported, as the commands do
keep_freed_memory()

import torch
from step import camera_of, sphere

from visdom_plugin import ssim
from visdom_plugin.losses import photometric_loss
from visdom_plugin.splat import optimiser as optimisers
from visdom_plugin.splat.cpu import backend, tiles
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise

REST, STEP = "rest", "step"


class Clock:
    """Milliseconds of one step by kernel."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)

    def around(self, module, name: str, label: str | None = None) -> None:
        """Times a function of a module; one that launches kernels by what it launches."""
        function = getattr(module, name)

        def timed(*arguments):
            began = time.perf_counter()
            result = function(*arguments)
            self.spent[label or arguments[0].__name__.strip("_")] += 1e3 * (time.perf_counter() - began)
            return result

        setattr(module, name, timed)


def measure(clock: Clock, n: int, size: int, threads: int, repeats: int) -> dict[str, float]:
    torch.set_num_threads(threads)
    camera, background, start = camera_of(size), torch.ones(3), sphere(n, 0).tensors()
    optimiser = optimisers.GaussianOptimiser(start, dict.fromkeys(start, 1e-4))
    with torch.no_grad():
        target = rasterise(sphere(n, 1), camera, background, near=0.01).rgb
    best: dict[str, float] = defaultdict(lambda: math.inf)
    for _ in range(repeats):
        clock.spent.clear()
        began = time.perf_counter()
        rgb = rasterise(Gaussians(**optimiser.parameters), camera, background, near=0.01).rgb
        photometric_loss(rgb, target, 0.2).backward()
        optimiser.step()
        took = 1e3 * (time.perf_counter() - began)
        for name, value in (*clock.spent.items(), (REST, took - sum(clock.spent.values())), (STEP, took)):
            best[name] = min(best[name], value)
    return dict(best)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sizes", nargs="+", default=["20000x200", "50000x400"], metavar="NxP")
    parser.add_argument("--repeats", type=int, default=40)
    arguments = parser.parse_args()
    backend.warm_up()
    clock = Clock()
    for module in (backend, tiles, ssim):
        clock.around(module, "parallel_for")
    clock.around(optimisers.adam, "update", "Adam")
    sizes = [tuple(map(int, size.split("x"))) for size in arguments.sizes]
    columns = [
        measure(clock, n, size, threads, arguments.repeats)
        for n, size in sizes
        for threads in arguments.threads
    ]
    print(
        "ms", *(f"{n} {size}x{size} {t} threads" for n, size in sizes for t in arguments.threads), sep=" | "
    )
    for name in columns[0]:
        print(name, *(f"{column[name]:.2f}" for column in columns), sep=" | ")


if __name__ == "__main__":
    main()
