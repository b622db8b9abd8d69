# ruff: noqa: E402
"""Speed of the hash encoding on the CPU, forward and backward, against the plain torch version of the same run.

    python benchmarks/nerf/hash_grid.py [--repeats 10] [--one-thread]

Points lie along random rays, 32 (groups of) points each, as in training. Times are the least of several runs,
taken in turns; "ns" is wall time per point, level and corner. Features are compared before anything is timed.
With --one-thread both use one thread and its own processor time is taken: what to compare on a busy machine.
"""

from __future__ import annotations

import argparse
import time

from visdom_plugin.compute.process import wait_briefly

wait_briefly()  # before torch is imported, as the commands do

import torch

from visdom_plugin.nerf.encoding.hash_grid import HashLayout, encode, encode_mean, initial_table

PER_RAY = 32

CASES = (
    # name, groups, samples in a group (0: plain points), with gradient, layout
    ("ingp step", 32768, 0, True, HashLayout()),
    ("ingp step, 2^19 rows", 32768, 0, True, HashLayout(max_resolution=2048, log2_table_size=19)),
    ("zip-nerf step", 8192, 6, True, HashLayout(features=4)),
    ("zip-nerf proposal step", 32768, 6, True, HashLayout(levels=6, features=1)),
    ("rendering 10,000 rays", 10000 * PER_RAY, 0, False, HashLayout()),
)


def points_on_rays(groups: int, samples: int, generator: torch.Generator) -> torch.Tensor:
    """(groups, samples, 3) in [0, 1]^3: points in order along rays through the box, samples close together."""
    rays = groups // PER_RAY
    ends = torch.rand(2, rays, 1, 1, 3, generator=generator)
    way = torch.rand(rays, PER_RAY, 1, 1, generator=generator).sort(1).values
    noise = 0.003 * torch.randn(rays, PER_RAY, samples, 3, generator=generator)
    return (ends[0] + (ends[1] - ends[0]) * way + noise).reshape(-1, samples, 3)


def least(calls: dict, repeats: int, clock) -> dict:
    """Seconds of the fastest of several runs of each, taking turns."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            start = clock()
            call()
            best[name] = min(best[name], clock() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--one-thread", action="store_true")
    args = parser.parse_args()
    repeats, clock = args.repeats, time.perf_counter
    if args.one_thread:
        torch.set_num_threads(1)
        clock = time.thread_time
    generator = torch.Generator().manual_seed(0)
    print(f"{torch.get_num_threads()} threads")
    print(f"{'':24s} forward ms    ns   both ms    ns   torch: forward ms   both ms   faster by")
    for name, groups, samples, training, layout in CASES:
        table = initial_table(layout, generator, 1.0).requires_grad_(training)
        points = points_on_rays(groups, max(samples, 1), generator)
        scales = 0.01 * torch.rand(groups, samples, generator=generator)
        g_out = torch.randn(groups, layout.width, generator=generator)

        def forward(
            backend, table=table, points=points, scales=scales, layout=layout, samples=samples
        ) -> torch.Tensor:
            if samples:
                return encode_mean(points, scales, table, layout, backend)[0]
            return encode(points[:, 0], table, layout, backend)

        def both(backend, table=table, g_out=g_out, forward=forward):
            return torch.autograd.grad(forward(backend), table, g_out)

        with torch.no_grad():
            torch.testing.assert_close(forward("cpu"), forward("torch"), rtol=1e-4, atol=1e-5)
            calls = {backend: lambda f=forward, b=backend: f(b) for backend in ("cpu", "torch")}
            go = least(calls, repeats, clock)
        corners = points[..., 0].numel() * layout.levels * 8
        line = f"{name:24s} {1e3 * go['cpu']:10.2f} {1e9 * go['cpu'] / corners:5.2f}"
        if training:
            both("cpu")
            step = least(
                {backend: lambda f=both, b=backend: f(b) for backend in ("cpu", "torch")}, repeats, clock
            )
            line += f" {1e3 * step['cpu']:9.2f} {1e9 * step['cpu'] / corners:5.2f} {1e3 * go['torch']:19.1f}"
            line += f" {1e3 * step['torch']:9.1f} {step['torch'] / step['cpu']:11.1f}"
        else:
            line += f" {'':15s} {1e3 * go['torch']:19.1f} {'':9s} {go['torch'] / go['cpu']:11.1f}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
