# ruff: noqa: E402
"""Time of a NeRF's work on rays, hash grid and nets apart: kernels for the CPU against the same in plain torch.

    python benchmarks/nerf/rays.py [--rays 1024] [--repeats 15]

Both forms run in turn in one process; times are the least of the repeats. Losses and rendering include backward.
"""

from __future__ import annotations

import argparse
import time

from visdom_plugin.compute.process import wait_briefly

wait_briefly()  # before torch is imported, as the commands do

import torch

from visdom_plugin.nerf.rendering import proposal_losses, volume_packed
from visdom_plugin.nerf.sampling import contraction, multisampling, step_functions


def backward(out) -> None:
    sum(x.sum() for x in (out if isinstance(out, tuple) else (out,)) if x.requires_grad).backward()


def cases(rays: int):
    """name, kernel, torch, for 64 proposal intervals and 32 of the NeRF's per ray."""
    torch.manual_seed(0)
    coarse, fine = (torch.rand(rays, n + 1).sort(-1).values for n in (64, 32))
    w_coarse, w_fine = torch.rand(rays, 64) / 64, torch.rand(rays, 32) / 32
    jitter = torch.rand(rays, 1)
    yield (
        "sample 32 edges from 64 intervals",
        lambda: step_functions.sample_edges(coarse, w_coarse, 32, jitter),
        lambda: step_functions._sample_torch(coarse, w_coarse, 32, jitter),
    )
    learnt = w_coarse.clone().requires_grad_()
    yield (
        "anti-aliased interlevel loss",
        lambda: backward(proposal_losses.antialiased_interlevel_loss(fine, w_fine, coarse, learnt, 0.03)),
        lambda: backward(proposal_losses._antialiased_torch(fine, w_fine, coarse, learnt, 0.03, 1e-5)),
    )
    density, rgb = torch.rand(rays * 32).requires_grad_(), torch.rand(rays * 32, 3).requires_grad_()
    starts, ends = fine[:, :-1].flatten(), fine[:, 1:].flatten()
    packed = (density, rgb, starts, ends, torch.arange(rays + 1) * 32, torch.rand(rays, 3))
    yield (
        "composite 32 packed samples",
        lambda: backward(volume_packed.composite_packed(*packed)),
        lambda: backward(volume_packed._composite_torch(*packed)),
    )
    unit = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1)
    hexagons = (torch.zeros(rays, 3), unit, coarse, torch.full((rays,), 1e-3), torch.rand(rays, 64), 0.5)
    yield (
        "64 x 6 multisamples",
        lambda: multisampling.multisample(*hexagons),
        lambda: multisampling._multisample_torch(*hexagons),
    )
    points, std = multisampling.multisample(*hexagons)
    points = 2 * points
    yield (
        "contract 64 x 6 points, half outside",
        lambda: contraction.contract(points, std),
        lambda: contraction._contract_torch(points, std),
    )


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args(argv)
    print(f"| {args.rays} rays | kernel ms | torch ms | torch / kernel |\n| --- | --- | --- | --- |")
    for name, *forms in cases(args.rays):
        times = [[], []]
        for _ in range(args.repeats + 2):  # the first two compile and warm up
            for form, spent in zip(forms, times, strict=True):
                start = time.perf_counter()
                form()
                spent.append(1e3 * (time.perf_counter() - start))
        kernel, plain = (min(spent[2:]) for spent in times)
        print(f"| {name} | {kernel:.2f} | {plain:.2f} | {plain / kernel:.1f} |")


if __name__ == "__main__":
    main()
