"""SplatFields lite: Gaussians whose attributes a neural field predicts from where they are.

Mihajlovic et al. 2024: a field of limited capacity, made from frozen noise, gives neighbours similar attributes,
which a few views alone do not. Hooks, where there are any, give the initial points and add their losses.
"""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.splats.common import scene_extent
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.methods.splats.one_set import Drawn, OneSetMethod
from visdom_plugin.methods.splats.splatfields.config import SplatFieldsConfig
from visdom_plugin.methods.splats.splatfields.field_set import FieldSet
from visdom_plugin.methods.splats.splatfields.moran import moran_loss
from visdom_plugin.methods.splats.strategy import Schedule
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import ViewBatch


class SplatFieldsLite(OneSetMethod[SplatFieldsConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        xyz, rgb = draw_points(self.hooks, hull, views, self.config.initial_points, generator)
        self.splats = self.make_set(xyz, rgb, views.cameras)
        # Opacities are the field's and cannot be reset one by one.
        self.follow(Schedule(reset_opacity=range(0)))
        self.look_at = (look_at_point(views.cameras).double() / self.unit).float().to(self.device)

    def make_set(self, xyz: Tensor, rgb: Tensor, cameras: Cameras) -> FieldSet:
        return FieldSet(
            self.config,
            xyz,
            rgb,
            extent=scene_extent(cameras),
            device=self.device,
            unit=self.unit,
            generator=seeding.generator(self.seed, "field"),
        )

    def own_losses(self, batch: ViewBatch, drawn: Drawn, step: int) -> dict[str, Tensor]:
        c, losses = self.config, {}
        if c.mask_l1_weight and batch.mask_known:
            error = (drawn.render.alpha - batch.mask).abs()
            weight = torch.ones_like(error) if batch.weight is None else batch.weight
            losses["mask_l1"] = c.mask_l1_weight * (error * weight).sum() / weight.sum().clamp_min(1)
        if c.norm_weight:
            losses["norm"] = c.norm_weight * (drawn.gaussians.means - self.look_at).norm(dim=-1).mean()
        if c.moran_weight and len(drawn.gaussians) > 1:
            draw = seeding.generator(self.seed, "moran", step)
            losses["moran"] = c.moran_weight * moran_loss(drawn.gaussians, draw)
        return losses
