"""3DGS-GO: Gaussians that start in a hull and are fitted to a few masked photographs.

The coarse stage of GaussianObject (Yang et al. 2024) on 3DGS (Kerbl et al. 2023), without the diffusion
repair. Hooks, where there are any, give the initial points and add their losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hull.hull import Hull
from visdom_plugin.losses import disparity_loss
from visdom_plugin.methods.splats.common import draw_background, fit_view, load_kernels, scene_extent
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.methods.splats.strategy import Schedule, Strategy, every
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.seeding import generator
from visdom_plugin.splat.model import GaussianSet
from visdom_plugin.splat.ply import write_gaussians
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.training.protocols import StepOutput, ViewBatch


class GsGo:
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def __init__(self, config: GsGoConfig):
        self.config = config
        self.total_steps = config.steps

    def setup(
        self,
        views: Views,
        hooks: Sequence[GaussianHook],
        *,
        hull: Hull | None,
        device: torch.device,
        seed: int,
    ) -> None:
        c, self.origin = self.config, views.origin
        self.device, self.seed, self.hooks = device, seed, list(hooks)
        load_kernels(device)
        xyz, rgb = draw_points(self.hooks, hull, views, c.initial_points, generator(seed, "initial_points"))
        self.splats = GaussianSet(c, xyz, rgb, extent=scene_extent(views.cameras), device=device)
        schedule = Schedule(
            reset_opacity=every(c.opacity_reset_every, c.opacity_reset_every, c.densify_until),
            remove_strays=every(c.floater_every, c.floater_every, c.densify_until),
            stray_sigmas=c.floater_sigmas,
            prune_large_from=c.prune_large_from,
            largest=(c.prune_radius_px, c.prune_scale),
        )
        self.strategy = Strategy(self.splats, schedule, partial(generator, seed, "split"))

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        c = self.config
        degree, gaussians = self.strategy.sh_degree(step), self.splats.gaussians()
        background = draw_background(c, generator(self.seed, "step", step), self.device)
        render = rasterise(gaussians, batch.camera, background, sh_degree=degree)
        losses, psnr = fit_view(render, batch, background, c)
        if c.depth_weight and batch.mono_depth is not None and batch.mask_known:
            object_mask = batch.mask if batch.weight is None else batch.mask * batch.weight
            depth = disparity_loss(render.depth, render.alpha, batch.mono_depth, object_mask)
            if depth is not None:
                losses["depth"] = c.depth_weight * depth
        for i, hook in enumerate(self.hooks):
            losses |= hook.loss(
                lambda camera: rasterise(gaussians, camera, background, sh_degree=degree),
                step,
                generator(self.seed, "hook", i, step),
            )
        return StepOutput(losses, {"psnr": psnr}, [render])

    @torch.no_grad()
    def optimise(self, step: int, output: StepOutput) -> None:
        self.strategy.after_backward(step, output.renders[0])
        self.strategy.after_step(self.hooks, step)

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        return rasterise(self.splats.gaussians(), camera, background.to(self.device))

    def state_dict(self) -> dict[str, Tensor]:
        return self.strategy.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.strategy.load_state_dict(state)

    def export(self, folder: Path) -> list[Path]:
        path = Path(folder) / "point_cloud.ply"
        write_gaussians(path, self.splats.gaussians(), self.origin)
        return [path]
