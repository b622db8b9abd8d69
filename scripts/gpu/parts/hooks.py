"""What the hooks cost on the device: medians of single calls, kernel launches and waits of the host in a call."""

from __future__ import annotations

from types import SimpleNamespace

import project
import subjects
import torch
from bench import Bench, Case


def cases(bench: Bench) -> list[Case]:
    found = [Case("hull on the device", hull_memory)]
    for count in (4096, 65_536, 1 << 20):
        found.append(Case(f"bounds of {count} rays", _bounds(bench.size(count, count >> 8))))
    found.append(Case("the same on the CPU, 65536", _bounds(bench.size(65_536, 256), "cpu")))
    found.append(Case("samples kept, 262144", _kept))
    for size in (200, 800):
        found.append(Case(f"hull's silhouette, {size} x {size}", _silhouette(bench.size(size, size // 5))))
    found.append(Case("L_i without the drawing, 800 x 800", _outside))
    found.append(Case("Gaussians outside, 100000", _after_step))
    found.append(Case("initial points, 20000", _initial_points))
    return bench.choose(found)


def _hull(bench: Bench):
    return subjects.hull_of_built_in(bench.size(256, 32))


def hull_memory(bench: Bench) -> dict:
    hull = _hull(bench)
    bench.reset_peak()
    origins, directions = (x.to(bench.device) for x in subjects.rays(subjects.built_in(100), 64))
    first = bench.median_ms(lambda: project.cast(hull, origins, directions), repeats=1, warm_up=0)
    return {"of": hull.occupancy.size, "ms": first, "peak MB": bench.peak_mb()}


def _bounds(count: int, device: str | None = None):
    def run(bench: Bench) -> dict:
        sampler, where = project.VisDomSampler(_hull(bench)), device or bench.device
        origins, directions = (x.to(where) for x in subjects.rays(subjects.built_in(100), count))

        def call():
            return sampler(origins, directions, 0.05, 6.0)

        ms = bench.median_ms(call)
        use = bench.device_use(call) if device is None else {}
        return {"of": count, "ms": ms, "M/s": count / ms / 1000, **use}

    return run


def _kept(bench: Bench) -> dict:
    sampler = project.VisDomSampler(_hull(bench), drop_outside=True)
    draw = torch.Generator().manual_seed(0)
    points = torch.randn(bench.size(1 << 18, 256), 3, generator=draw).to(bench.device)
    ms = bench.median_ms(lambda: sampler.keep(points))
    return {
        "of": len(points),
        "ms": ms,
        "M/s": len(points) / ms / 1000,
        **bench.device_use(lambda: sampler.keep(points)),
    }


def _silhouette(size: int):
    def run(bench: Bench) -> dict:
        hull = _hull(bench)
        one = subjects.built_in(100).train.cameras[0].resized(size, size).to(bench.device)

        def call():
            return project.depth_and_silhouette(hull, one)

        ms = bench.median_ms(call, repeats=10)
        return {"of": size * size, "ms": ms, "M/s": size * size / ms / 1000, **bench.device_use(call)}

    return run


def _regularizer(bench: Bench, size: int):
    cameras = subjects.built_in(100).train.cameras.resized(size, size)
    return project.VisDomGaussianRegularizer(_hull(bench), cameras.to(bench.device), bank=4, prune_every=1)


def _outside(bench: Bench) -> dict:
    size = bench.size(800, 40)
    hook = _regularizer(bench, size)
    alpha = (
        torch.rand(size, size, generator=torch.Generator().manual_seed(0)).to(bench.device).requires_grad_()
    )

    def call():
        hook.loss(lambda camera: alpha, 0)["visdom_outside"].backward()

    for _ in range(40):  # draws every view of the bank once
        call()
    return {"of": size * size, "ms": bench.median_ms(call), **bench.device_use(call)}


def _after_step(bench: Bench) -> dict:
    hook = _regularizer(bench, 40)
    draw = torch.Generator().manual_seed(0)
    means = torch.randn(bench.size(100_000, 500), 3, generator=draw).to(bench.device)

    def call():
        return hook.after_step(SimpleNamespace(means=means), 0)

    return {"of": len(means), "ms": bench.median_ms(call), **bench.device_use(call)}


def _initial_points(bench: Bench) -> dict:
    hook = _regularizer(bench, 40)
    count = bench.size(20_000, 200)
    draw = torch.Generator().manual_seed(0)
    return {"of": count, "ms": bench.median_ms(lambda: hook.initial_points(count, draw), repeats=3)}
