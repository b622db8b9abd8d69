"""Step times at the published sizes on the capture: wall time over steps without a wait between them, launches
and waits in one step, the share of the hook, most memory, and what that makes of the whole schedule. Beside them a
bare loop around gsplat and nerfacc themselves."""

from __future__ import annotations

import time

import subjects
import torch
from bench import Bench, Case


def cases(bench: Bench) -> list[Case]:
    found = []
    for name in subjects.VARIANTS:
        needs = () if name.startswith(("ingp", "zipnerf", "zerorf")) else ("gsplat",)
        found.append(Case(name, _steps(name), 60, needs))
    found.append(Case("gsplat's own step, 20000", gsplat_step, 40, ("gsplat",), only_cuda=True))
    found.append(Case("nerfacc's own sampling and rendering", nerfacc_step, 40, ("nerfacc",), only_cuda=True))
    return bench.choose(found)


class HookClock:
    """Times a method's hooks, and the drawing that happens inside of them, waiting for the device around each."""

    def __init__(self, bench: Bench, hooks):
        self.bench, self.hook_s, self.drawing_s = bench, 0.0, 0.0
        for hook in hooks:
            for name in ("bound", "bound_pixels", "after_step", "loss"):
                if hasattr(hook, name):
                    setattr(hook, name, self._around(getattr(hook, name), name))

    def _around(self, function, name: str):
        def timed(*args, **kwargs):
            if name == "loss":
                draw = args[0]
                args = (lambda camera: self._time("drawing_s", draw, camera), *args[1:])
            return self._time("hook_s", function, *args, **kwargs)

        return timed

    def _time(self, where: str, function, *args, **kwargs):
        self.bench.synchronise()
        began = time.perf_counter()
        out = function(*args, **kwargs)
        self.bench.synchronise()
        setattr(self, where, getattr(self, where) + time.perf_counter() - began)
        return out


def _steps(name: str):
    def run(bench: Bench) -> dict:
        scene = subjects.capture(bench)
        budget = "quick" if bench.tiny else "full"
        bench.reset_peak()
        method, batches, config = subjects.start(bench, name, scene, bench.device, budget=budget)
        warm_up, timed, clocked = (2, 2, 2) if bench.tiny else (60, 100, 20)
        at = 0
        for _ in range(warm_up):
            subjects.step_once(method, batches, at)
            at += 1
        bench.synchronise()
        began = time.perf_counter()
        for _ in range(timed):
            subjects.step_once(method, batches, at)
            at += 1
        bench.synchronise()
        ms = 1000 * (time.perf_counter() - began) / timed
        values = {
            "ms a step": ms,
            "whole schedule, min": ms * config.steps / 60_000,
            "peak MB": bench.peak_mb(),
        }
        step = iter(range(at, at + 10))
        values |= bench.device_use(lambda: subjects.step_once(method, batches, next(step)))
        if method.hooks:
            clock = HookClock(bench, method.hooks)
            began = time.perf_counter()
            for i in range(clocked):
                subjects.step_once(method, batches, at + 10 + i)
            bench.synchronise()
            whole = time.perf_counter() - began
            own = clock.hook_s - clock.drawing_s
            values |= {"hook ms": 1000 * own / clocked, "hook %": 100 * own / (whole - clock.drawing_s)}
        return values

    return run


def gsplat_step(bench: Bench) -> dict:
    """Drawing, L1, backward and Adam by gsplat and torch alone."""
    from gsplat import rasterization

    one = subjects.gaussians(20_000).to(bench.device)
    p = {k: v.detach().clone().requires_grad_() for k, v in one.tensors().items()}
    camera = subjects.camera(800, 800).to(bench.device)
    motion, K = camera.camera_from_world[None].contiguous(), camera.intrinsics[None].contiguous()
    adam = torch.optim.Adam(list(p.values()), lr=1e-4, fused=True)
    target = torch.rand(800, 800, 3, device=bench.device)

    def step() -> None:
        image, _, _ = rasterization(
            p["means"], p["quaternions"], p["log_scales"].exp(), p["opacity_logits"].sigmoid(), p["sh"],
            motion, K, 800, 800, sh_degree=3, packed=False,
        )  # fmt: skip
        (image[0] - target).abs().mean().backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    bench.reset_peak()
    ms = bench.median_ms(step, repeats=50)
    return {"ms a step": ms, "peak MB": bench.peak_mb(), **bench.device_use(step)}


def nerfacc_step(bench: Bench) -> dict:
    """Sampling 4096 rays in nerfacc's occupancy grid and rendering them, forward and backward, without a field."""
    import nerfacc

    scene = subjects.built_in(100)
    origins, directions = (x.to(bench.device) for x in subjects.rays(scene, 4096))
    grid = nerfacc.OccGridEstimator([-1.0, -1, -1, 1, 1, 1], 128, 1).to(bench.device)
    grid.train()
    grid.update_every_n_steps(0, lambda x: (x.norm(dim=-1, keepdim=True) < 0.5).float())

    def step() -> None:
        ray, starts, ends = grid.sampling(
            origins, directions, render_step_size=0.004, near_plane=0.05, stratified=True
        )
        density = torch.ones_like(starts, requires_grad=True)
        rgb = torch.ones(len(starts), 3, device=bench.device, requires_grad=True)
        colour, _, _, _ = nerfacc.rendering(
            starts, ends, ray, len(origins), rgb_sigma_fn=lambda *_: (rgb, density)
        )
        colour.sum().backward()

    bench.reset_peak()
    ms = bench.median_ms(step, repeats=30)
    return {"ms a step": ms, "peak MB": bench.peak_mb(), **bench.device_use(step)}
