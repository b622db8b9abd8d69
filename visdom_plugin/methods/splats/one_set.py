"""Base of the methods that fit one set of Gaussians: the losses of a step, and what follows its backward pass."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.methods.splats.common import draw_background, drop_some, fit_view
from visdom_plugin.methods.splats.splat_method import Config, SplatMethod
from visdom_plugin.methods.splats.strategy import Schedule, Strategy
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.training.protocols import StepOutput, ViewBatch


class Drawn(NamedTuple):
    """What a step draws."""

    render: Render
    """The training view."""
    gaussians: Gaussians
    """The step's Gaussians, in the set's own unit, attached to the graph."""
    show: Callable[[Cameras], Render]
    """Draws them from another camera, on the same background."""


class OneSetMethod(SplatMethod[Config]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    strategy: Strategy
    """Of `splats`; made by `build`, see `follow`."""

    def follow(self, schedule: Schedule) -> None:
        """Has the Gaussians, which `build` made, change their number by a schedule."""
        self.strategy = Strategy(self.splats, schedule, partial(seeding.generator, self.seed, "split"))

    def own_losses(self, batch: ViewBatch, drawn: Drawn, step: int) -> dict[str, Tensor]:
        """What a method adds to the losses that all share: weighted scalars by name."""
        return {}

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        c = self.config
        degree, rate = self.strategy.sh_degree(step), c.dropout * step / c.steps
        gaussians = drop_some(self.splats.gaussians(), rate, seeding.generator(self.seed, "dropout", step))
        background = draw_background(c, seeding.generator(self.seed, "step", step), self.device)

        def show(camera: Cameras) -> Render:
            return self.splats.draw(camera, background, gaussians, degree)

        render = show(batch.camera)
        losses, psnr = fit_view(render, batch, background, c, self.correction)
        losses |= self.own_losses(batch, Drawn(render, gaussians, show), step)
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

    def events(self) -> dict[str, list[int]]:
        """See `Strategy.events`."""
        return self.strategy.events()

    def state_dict(self) -> dict[str, Tensor]:
        return self.strategy.state_dict() | self.correction_state()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.strategy.load_state_dict(state)
        self.load_correction(state)
