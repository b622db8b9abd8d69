"""What the cases look at: scenes, hulls, rays, Gaussians, methods. Made on the CPU from fixed seeds."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import project
import torch
from torch import Tensor

METHODS = ("3dgs-go", "ingp", "corgs-lite", "zipnerf-lite", "zerorf-lite", "fsgs-lite", "splatfields-lite")
VARIANTS = tuple(name + suffix for name in METHODS for suffix in ("+vd", ""))


@cache
def built_in(size: int):
    """The built-in scene with pictures of `size` pixels and 4 training views."""
    return project.make_scene(project.SyntheticConfig(size=size))


@cache
def hull_of_built_in(resolution: int, size: int = 100):
    """The visible domain of the built-in scene's training views."""
    views = built_in(size).train
    return project.VisibleDomain(dilate_px=1, resolution=resolution).carve(*views.silhouettes())


@cache
def capture(bench):
    """The capture that was carried along, with 4 views; the built-in scene where there is none."""
    if bench.scene_path is None:
        return built_in(bench.size(200, 48))
    return project.load(bench.scene_path, views=4, downscale=8 if bench.tiny else bench.settings["downscale"])


def rays(scene, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Origins and directions (count, 3) through random places of random training views."""
    draw = torch.Generator().manual_seed(seed)
    cameras = scene.train.cameras
    view = torch.randint(len(cameras), (count,), generator=draw)
    size = torch.stack([cameras.width, cameras.height], -1)[view].double()
    uv = torch.rand(count, 2, generator=draw, dtype=torch.float64) * size
    found = project.rays_of(cameras[view], uv[:, None])
    return found.origins[:, 0].to(dtype), found.directions[:, 0].to(dtype)


def gaussians(count: int, degree: int = 3, seed: int = 0):
    """Gaussians about the unit sphere, as wide as their distance from each other."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw)

    means = torch.nn.functional.normalize(normal(count, 3), dim=-1) * (1 + 0.02 * normal(count, 1))
    log_scales = 0.5 * math.log(4 * math.pi / count) + 0.3 * normal(count, 3)
    sh = 0.2 * normal(count, (degree + 1) ** 2, 3)
    return project.Gaussians(means, log_scales, normal(count, 4), 1.5 * normal(count), sh)


def camera(width: int, height: int):
    """A camera three units before the origin, looking at it."""
    motion = torch.eye(4)
    motion[:3, 3] = torch.tensor([0.1, -0.2, -3.0])
    focal = 1.1 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return project.Cameras.from_matrices(K, motion, width=width, height=height)


def start(bench, name: str, scene, device: torch.device, *, budget: str = "quick", **changes):
    """A method set up on the training views: the method, a function from step to batch, and its config."""
    preset = project.find(name)
    config = replace(preset.settings(budget), **changes)
    if bench.tiny:
        config = _shrink(config)
    method, _, _ = project.build(preset, config, scene.train, device=device, seed=0)
    batches = project.choose_batches(method, project.DataManager(scene.train, 0, device=device))
    return method, batches, config


def _shrink(config):
    """The settings with a coarse hull and few Gaussians or rays, so that a dry run is over soon."""
    small = {"initial_points": 500, "max_rays": 64, "rays": 64, "occupancy_resolution": 16}
    changes = {name: value for name, value in small.items() if hasattr(config, name)}
    if config.hull is not None:
        changes["hull"] = replace(config.hull, resolution=32)
    return replace(config, **changes)


def step_once(method, batches, step: int) -> None:
    """One training step."""
    output = method.train_step(batches(step), step)
    output.total.backward()
    method.optimise(step, output)
