"""FSGS lite: Gaussians that grow where they are far apart, and whose depth follows monocular depth.

Zhu et al. 2024: unpooling adds Gaussians between distant neighbours, and the depth of training views and of views
that nobody photographed is correlated with what a network sees in the picture. Hooks, where there are any, give
the initial points and add their losses.
"""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.splats.fsgs.config import FsgsConfig
from visdom_plugin.methods.splats.fsgs.depth import OPAQUE, DepthProvider, of_disparity, pearson
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.methods.splats.one_set import Drawn, OneSetMethod
from visdom_plugin.methods.splats.pseudo_views import PseudoViews
from visdom_plugin.methods.splats.strategy import Schedule, Unpooling, every
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import ViewBatch


class FsgsLite(OneSetMethod[FsgsConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    fewest_views = 2

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        c = self.config
        xyz, rgb = draw_points(self.hooks, hull, views, c.initial_points, generator)
        self.splats = self.make_set(xyz, rgb, views.cameras)
        unpooling = Unpooling(c.unpool_until, c.unpool_distance, c.unpool_scale, c.unpool_split_distance)
        reset = every(c.opacity_reset_every, c.opacity_reset_from, c.steps + 1)
        self.follow(Schedule(reset, unpooling=unpooling))
        self.pseudo = PseudoViews(c.pseudo_views, views.cameras)
        self.depth = DepthProvider(views, c.depth_network, self.device)

    def own_losses(self, batch: ViewBatch, drawn: Drawn, step: int) -> dict[str, Tensor]:
        c, done, losses = self.config, step + 1, {}
        weight = c.depth_weight if done <= c.depth_until else c.depth_weight_late
        if self.depth.training and weight:
            losses["depth"] = weight * self._training_depth(batch, drawn.render)
        due = c.pseudo_every and c.pseudo_from <= done <= c.pseudo_until and done % c.pseudo_every == 0
        ramp = min((done - c.pseudo_from) / max(c.pseudo_ramp, 1), 1.0)
        if self.depth.network is not None and due and ramp * c.pseudo_weight:
            view = drawn.show(self.pseudo.draw(seeding.generator(self.seed, "pseudo", step)))
            seen = of_disparity(self.depth.predict(view.rgb)).forms[0]
            opaque = (view.alpha.detach() > OPAQUE).float()
            unlike = 1 - pearson(seen, view.depth / self.unit, opaque)
            losses["pseudo_depth"] = ramp * c.pseudo_weight * unlike
        return losses

    def _training_depth(self, batch: ViewBatch, render: Render) -> Tensor:
        """1 - correlation of the training view with that reading of its monocular depth which fits better."""
        mono = self.depth.training[batch.index]
        weight = mono.known * (render.alpha.detach() > OPAQUE)
        if batch.mask_known:
            weight = weight * batch.mask
        if batch.weight is not None:
            weight = weight * batch.weight
        # In a unit of the capture's own, as all else that has a threshold.
        rendered = render.depth / self.unit
        return 1 - torch.stack([pearson(form, rendered, weight) for form in mono.forms]).max()
