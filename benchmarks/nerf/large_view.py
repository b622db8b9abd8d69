# ruff: noqa: E402
"""Seconds and memory of one view of a field at the size of a photograph.

    python benchmarks/nerf/large_view.py [--method ingp+vd] [--steps 600] [--size 4000 3000] [--one-in 1]

A field of the built-in scene is trained for some steps; then its first test view is drawn.
With --one-in N every N-th chunk of rays is drawn, and the time extrapolated.
"""

from __future__ import annotations

import argparse
import resource
import time

from visdom_plugin.compute.process import wait_briefly

wait_briefly()  # before torch is imported, as the commands do

import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.geometry.cameras import pixel_radius, rays_of
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import build


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", default="ingp+vd")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--size", type=int, nargs=2, default=[4000, 3000])
    parser.add_argument("--one-in", type=int, default=1)
    args = parser.parse_args()
    scene = make_scene(SyntheticConfig())
    spec, data = registry.find(args.method), DataManager(scene.train, seed=0)
    method, _, _ = build(spec, spec.quick, scene.train, device=torch.device("cpu"), seed=0)
    for step in range(args.steps):
        batch = data.pixel_batch(step, method.pixels_per_step(step))
        output = method.train_step(batch, step)
        output.total.backward()
        method.optimise(step, output)
    small, camera = scene.test.cameras[0], scene.test.cameras[0].resized(*args.size)
    method.render(small, torch.ones(3))
    before, began = peak_mib(), time.perf_counter()
    seconds = draw_some(method, camera, args.one_in) if args.one_in > 1 else 0.0
    if args.one_in == 1:
        method.render(camera, torch.ones(3))
        seconds = time.perf_counter() - began
    grown = peak_mib() - before
    print(
        f"{args.method}, {args.size[0]} x {args.size[1]}: {seconds:.1f} s, one chunk in {args.one_in} drawn"
    )
    print(f"memory: {before:.0f} MiB before, {grown:.0f} MiB more while it was drawn")


def draw_some(method, camera, one_in: int) -> float:
    """Seconds of the whole picture, from every `one_in`-th chunk."""
    camera, radius = camera.to(dtype=torch.float64), pixel_radius(camera)
    (width, height), chunk = camera.size, method.rays_at_once
    drawn, began = 0, time.perf_counter()
    for first in range(0, width * height, chunk * one_in):
        pixels = torch.arange(first, min(first + chunk, width * height))
        origins, directions = rays_of(camera, torch.stack([pixels % width, pixels // width], -1) + 0.5)
        with torch.no_grad():
            method.render_rays(origins, directions, radius, torch.ones(3))
        drawn += len(pixels)
    return (time.perf_counter() - began) * width * height / drawn


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
