"""CoR-GS lite: two sets of Gaussians fitted to the same photographs, each a check on the other.

Zhang et al. 2024: where two sets that differ only by the randomness of densification disagree, both are likely
wrong. Co-regularisation draws their renders of unseen views together, co-pruning removes Gaussians that have no
counterpart. Hooks, where there are any, give the initial points and add their losses to each set.
"""

from __future__ import annotations

import logging
from functools import partial

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.losses import photometric_loss
from visdom_plugin.methods.splats.common import draw_background, drop_some, fit_view
from visdom_plugin.methods.splats.configs import CorgsConfig
from visdom_plugin.methods.splats.initial_points import draw_box, draw_points
from visdom_plugin.methods.splats.pseudo_views import PseudoViews
from visdom_plugin.methods.splats.splat_method import SplatMethod
from visdom_plugin.methods.splats.strategy import Schedule, Strategy, every
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.training.protocols import StepOutput, ViewBatch

log = logging.getLogger(__name__)


class CorgsLite(SplatMethod[CorgsConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does. Set 0 is shown and exported."""

    fewest_views = 2

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        c = self.config
        self.pseudo = PseudoViews(c.pseudo_views, views.cameras)
        if c.initial_cloud == "random" and not self.hooks:
            xyz, rgb = draw_box(views.cameras, c.initial_points, generator)
        else:
            xyz, rgb = draw_points(self.hooks, hull, views, c.initial_points, generator)
        self.sets = [self.make_set(xyz, rgb, views.cameras) for _ in range(2)]
        self.splats = self.sets[0]
        schedule = Schedule(every(c.opacity_reset_every, c.opacity_reset_from, c.steps + 1))
        self.strategies = [
            Strategy(one, schedule, partial(seeding.generator, self.seed, "split", i))
            for i, one in enumerate(self.sets)
        ]
        extents, world = c.co_prune_extents * self.splats.extent, c.co_prune_world
        self.co_prune_distance = extents if world is None else world / self.unit

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        c, done = self.config, step + 1
        degree = self.strategies[0].sh_degree(step)
        background = draw_background(c, seeding.generator(self.seed, "step", step), self.device)
        rate = c.dropout * step / c.steps
        sets = [
            drop_some(one.gaussians(), rate, seeding.generator(self.seed, "dropout", i, step))
            for i, one in enumerate(self.sets)
        ]

        def show(gaussians: Gaussians, camera: Cameras) -> Render:
            return self.splats.draw(camera, background, gaussians, degree)

        renders = [show(gaussians, batch.camera) for gaussians in sets]
        (losses, psnr), (others, _) = (
            fit_view(render, batch, background, c, self.correction) for render in renders
        )
        losses = _numbered(losses, 0) | _numbered(others, 1)
        if c.pseudo_every and c.pseudo_from <= done <= c.pseudo_until and done % c.pseudo_every == 0:
            camera = self.pseudo_camera(step)
            first, second = (show(gaussians, camera).rgb for gaussians in sets)
            losses |= co_regularisation(first, second, c.ssim_weight, c.pseudo_weight)
        if self.virtual is not None:
            for i, gaussians in enumerate(sets):
                draw = seeding.generator(self.seed, "virtual", step)
                loss = self.virtual.loss(partial(show, gaussians), background, draw)
                losses[f"virtual_{i}"] = c.virtual_weight * loss
        for h, hook in enumerate(self.hooks):
            for i, gaussians in enumerate(sets):
                # The same numbers for both sets, so that the hook shows both the same views.
                draw = seeding.generator(self.seed, "hook", h, step)
                losses |= _numbered(hook.loss(partial(show, gaussians), step, draw), i)
        return StepOutput(losses, {"psnr": psnr}, renders)

    def pseudo_camera(self, step: int) -> Cameras:
        """The unseen view of a step, the same for both sets."""
        return self.pseudo.draw(seeding.generator(self.seed, "pseudo", step))

    @torch.no_grad()
    def optimise(self, step: int, output: StepOutput) -> None:
        c, done = self.config, step + 1
        for strategy, render in zip(self.strategies, output.renders, strict=True):
            strategy.after_backward(step, render)
        if c.co_prune_every and done > c.densify_from and done % c.co_prune_every == 0:
            self._co_prune(done)
        for strategy in self.strategies:
            strategy.after_step(self.hooks, step)
        self.step_correction(step)

    def events(self) -> dict[str, list[int]]:
        """See `Strategy.events`; the same for both sets."""
        return self.strategies[0].events()

    def _co_prune(self, done: int) -> None:
        first, second = (one.gaussians().means for one in self.sets)
        gone = unmatched(first, second, self.co_prune_distance)
        if bool(gone[0].all()):
            log.warning(
                "step %d: the two sets are nowhere closer than %.3g, none is pruned",
                done,
                self.co_prune_distance * self.unit,
            )
        for strategy, lonely in zip(self.strategies, gone, strict=True):
            strategy.remove(lonely, "without a neighbour in the other set")

    def state_dict(self) -> dict[str, Tensor]:
        states = (strategy.state_dict() for strategy in self.strategies)
        own = {f"set{i}.{name}": value for i, state in enumerate(states) for name, value in state.items()}
        return own | self.correction_state()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for i, strategy in enumerate(self.strategies):
            prefix = f"set{i}."
            strategy.load_state_dict({k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)})
        self.load_correction(state)


def co_regularisation(first: Tensor, second: Tensor, ssim_weight: float, weight: float) -> dict[str, Tensor]:
    """The image loss of each set's render of an unseen view towards the other's, which stays where it is.

    Args:
        first, second: (H, W, 3) the two sets' renders on the same background.
    """
    pairs = ((first, second.detach()), (second, first.detach()))
    return {f"co_{i}": weight * photometric_loss(a, b, ssim_weight) for i, (a, b) in enumerate(pairs)}


def unmatched(first: Tensor, second: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """Points of each set whose nearest neighbour in the other is farther away than `distance`.

    Both are measured before either loses any. If all points of one have none, so do all of the other's.

    Args:
        first, second: (N, 3) and (M, 3), N and M at least 1.

    Returns:
        (N,) and (M,) bool, True for those without a counterpart, on the inputs' device.
    """
    from scipy.spatial import cKDTree

    points = [x.detach().double().cpu().numpy() for x in (first, second)]
    trees = [cKDTree(p) for p in points]
    far = [np.asarray(trees[1 - i].query(points[i], workers=-1)[0] > distance) for i in range(2)]
    return torch.from_numpy(far[0]).to(first.device), torch.from_numpy(far[1]).to(second.device)


def _numbered(losses: dict[str, Tensor], i: int) -> dict[str, Tensor]:
    return {f"{name}_{i}": value for name, value in losses.items()}
