"""3DGS-GO: Gaussians that start in a hull and are fitted to a few masked photographs.

The coarse stage of GaussianObject (Yang et al. 2024) on 3DGS (Kerbl et al. 2023), without the diffusion
repair. Hooks, where there are any, give the initial points and add their losses.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.losses import disparity_loss
from visdom_plugin.methods.splats.common import draw_background, drop_some, fit_view
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.methods.splats.splat_method import SplatMethod
from visdom_plugin.methods.splats.strategy import LargestGaussian, Schedule, Strategy, every
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import StepOutput, ViewBatch


class GsGo(SplatMethod[GsGoConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        c = self.config
        xyz, rgb = draw_points(self.hooks, hull, views, c.initial_points, generator)
        self.splats = self.make_set(xyz, rgb, views.cameras)
        schedule = Schedule(
            reset_opacity=every(c.opacity_reset_every, c.opacity_reset_every, c.densify_until),
            remove_strays=every(c.floater_every, c.floater_every, c.densify_until),
            stray_sigmas=c.floater_sigmas,
            prune_large_from=c.prune_large_from,
            largest=LargestGaussian(c.prune_scale, c.prune_radius, c.prune_radius_px),
        )
        self.strategy = Strategy(self.splats, schedule, partial(seeding.generator, self.seed, "split"))

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        c = self.config
        degree, rate = self.strategy.sh_degree(step), c.dropout * step / c.steps
        gaussians = drop_some(self.splats.gaussians(), rate, seeding.generator(self.seed, "dropout", step))
        background = draw_background(c, seeding.generator(self.seed, "step", step), self.device)

        def show(camera: Cameras) -> Render:
            return self.splats.draw(camera, background, gaussians, degree)

        render = show(batch.camera)
        losses, psnr = fit_view(render, batch, background, c, self.correction)
        if c.depth_weight and batch.mono_depth is not None and batch.mask_known:
            object_mask = batch.mask if batch.weight is None else batch.mask * batch.weight
            depth = disparity_loss(render.depth, render.alpha, batch.mono_depth, object_mask)
            if depth is not None:
                losses["depth"] = c.depth_weight * depth
        if self.virtual is not None:
            draw = seeding.generator(self.seed, "virtual", step)
            losses["virtual"] = c.virtual_weight * self.virtual.loss(show, background, draw)
        for i, hook in enumerate(self.hooks):
            losses |= hook.loss(show, step, seeding.generator(self.seed, "hook", i, step))
        return StepOutput(losses, {"psnr": psnr}, [render])

    @torch.no_grad()
    def optimise(self, step: int, output: StepOutput) -> None:
        self.strategy.after_backward(step, output.renders[0])
        self.strategy.after_step(self.hooks, step)
        self.step_correction(step)

    def state_dict(self) -> dict[str, Tensor]:
        return self.strategy.state_dict() | self.correction_state()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.strategy.load_state_dict(state)
        self.load_correction(state)
