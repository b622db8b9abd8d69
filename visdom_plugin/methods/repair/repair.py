"""The last stage: the coarse Gaussians go on with photographs and with repaired novel views."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.repair.configs import GaussianObjectConfig
from visdom_plugin.methods.repair.diffusion import Networks, as_batch
from visdom_plugin.methods.repair.leave_one_out import State
from visdom_plugin.methods.repair.novel_views import NovelViews
from visdom_plugin.methods.repair.pictures import as_bytes, centre_camera
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.methods.splats.strategy import Strategy
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.metrics import load_lpips
from visdom_plugin.training.protocols import StepOutput, ViewBatch

log = logging.getLogger(__name__)


class FullHarmonics(Strategy):
    """All degrees of the harmonics from the first step on."""

    def sh_degree(self, step: int) -> int:
        return self.splats.config.sh_degree


class GoingOn(GsGo):
    """The coarse method in its last stage: Gaussians that are there already."""

    config: GaussianObjectConfig

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        super().build(views, hull, generator)
        schedule = replace(self.strategy.schedule, fewest=self.config.repair.fewest_gaussians)
        self.strategy = FullHarmonics(self.splats, schedule, self.strategy.split_generator)


def stage_config(config: GaussianObjectConfig) -> GaussianObjectConfig:
    """The coarse stage's settings as the last one has them."""
    c = config.repair
    return replace(
        config,
        steps=c.steps,
        lr_means=c.lr_means,
        lr_means_final=c.lr_means,
        densify_gradient=c.densify_gradient,
        densify_from=c.densify_from,
        densify_until=c.densify_until,
        densify_every=c.densify_every,
        prune_opacity=c.prune_opacity,
        prune_large_from=c.prune_large_from,
        opacity_reset_every=c.opacity_reset_every,
        floater_every=0,
    )


class Repair:
    """Steps on a training view and on a repaired one.

    Args:
        run: set up on the training views with `stage_config`, its Gaussians the coarse ones.
        cameras: (N,) training cameras.
        load: the fine-tuned networks; asked for when views are repaired.
    """

    def __init__(
        self,
        config: GaussianObjectConfig,
        run: GsGo,
        cameras: Cameras,
        load: Callable[[], Networks],
        seed: int,
    ):
        self.config, self.run, self.load, self.seed = config, run, load, seed
        self.steps = config.repair.steps
        self.novel = NovelViews(cameras, config.repair)
        self.targets: State = {}
        """Repaired views by number, and the weight of each one's score."""
        self._networks: Networks | None = None
        self._perceptual: Callable[[Tensor, Tensor], Tensor] | None = None
        self._looked_for_perceptual = False

    def view_at(self, step: int) -> int | None:
        """Any, in turn."""
        return None

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        c = self.config.repair
        output = self.run.train_step(batch, step)
        if step >= c.until:
            return output
        first, last = c.share
        share = first + (last - first) * step / max(c.until, 1)
        period, since = divmod(step, c.refresh_every)
        if since == 0:
            self._refresh(period)
        chosen = int(torch.randint(c.poses, (), generator=seeding.generator(self.seed, "repair", step)))
        camera = self._camera(period, chosen)
        white = torch.ones(3, device=self.run.device)
        render = self.run.splats.draw(camera.to(self.run.device), white)
        target = self.targets[f"target.{chosen}"].to(self.run.device).float() / 255
        weight = float(self.targets[f"score.{chosen}"]) * self.novel.weight(camera)
        losses = {name: (1 - share) * value for name, value in output.losses.items()}
        for name, value in self._differences(render, target).items():
            losses[f"repair_{name}"] = share * weight * value
        # Densification goes by the repaired view, not by the photograph (the authors' code).
        return StepOutput(losses, output.metrics, [render])

    def optimise(self, step: int, output: StepOutput) -> None:
        self.run.optimise(step, output)

    def state_dict(self) -> State:
        return {f"run.{k}": v for k, v in self.run.state_dict().items()} | self.targets

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        own = {k.removeprefix("run."): v for k, v in state.items() if k.startswith("run.")}
        self.run.load_state_dict(own)
        self.targets = {k: v for k, v in state.items() if not k.startswith("run.")}

    def _camera(self, period: int, number: int) -> Cameras:
        """One of the views that are repaired together."""
        camera = self.novel.draw(seeding.generator(self.seed, "novel", period, number))
        return centre_camera(camera, self.config.image_size)

    @torch.no_grad()
    def _refresh(self, period: int) -> None:
        """Draws other views with the Gaussians as they are and has them repaired."""
        c = self.config.repair
        networks = self._networks = self._networks or self.load()
        prompt = f"a photo of a {self.config.lora.token}, best quality"
        white = torch.ones(3, device=self.run.device)
        for i in range(c.poses):
            draw = seeding.generator(self.seed, "target", period, i)
            low, high = c.strength
            strength = low + (high - low) * float(torch.rand((), generator=draw))
            drawn = self.run.render(self._camera(period, i).to(self.run.device), white).rgb
            picture = as_bytes(drawn).float() / 255
            repaired, score = networks.repair(picture, prompt, strength, c, draw)
            self.targets[f"target.{i}"] = as_bytes(repaired).cpu()
            self.targets[f"score.{i}"] = torch.tensor(score, dtype=torch.float64)

    def _differences(self, render: Render, target: Tensor) -> State:
        c = self.config.repair
        difference = render.rgb - target
        found = {"l1": c.l1_weight * difference.abs().mean(), "l2": c.l2_weight * difference.square().mean()}
        if c.lpips_weight and (network := self._load_perceptual()) is not None:
            pair = (2 * as_batch(x) - 1 for x in (render.rgb, target))
            found["lpips"] = c.lpips_weight * network(*pair).mean()
        return found

    def _load_perceptual(self) -> Callable[[Tensor, Tensor], Tensor] | None:
        if not self._looked_for_perceptual:
            self._looked_for_perceptual = True
            network = load_lpips()
            if isinstance(network, torch.nn.Module):
                network = network.to(self.run.device)
            self._perceptual = network
            if network is None:
                log.warning(
                    "repair: the LPIPS term is off (repair.lpips_weight = %g): lpips or its VGG weights are not "
                    "here\n  what to do: pip install 'visdom-plugin[lpips]', or go on without",
                    self.config.repair.lpips_weight,
                )
        return self._perceptual
