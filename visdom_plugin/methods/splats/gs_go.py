"""3DGS-GO: Gaussians that start in a hull and are fitted to a few masked photographs.

The coarse stage of GaussianObject (Yang et al. 2024) on 3DGS (Kerbl et al. 2023), without the diffusion
repair. Hooks, where there are any, give the initial points and add their losses.
"""

from __future__ import annotations

from torch import Generator, Tensor

from visdom_plugin.hull.hull import Hull
from visdom_plugin.losses import disparity_loss
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.methods.splats.one_set import Drawn, OneSetMethod
from visdom_plugin.methods.splats.strategy import LargestGaussian, Schedule, every
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import ViewBatch


class GsGo(OneSetMethod[GsGoConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        c = self.config
        xyz, rgb = draw_points(self.hooks, hull, views, c.initial_points, generator)
        self.splats = self.make_set(xyz, rgb, views.cameras)
        self.follow(
            Schedule(
                reset_opacity=every(c.opacity_reset_every, c.opacity_reset_every, c.densify_until),
                remove_strays=every(c.floater_every, c.floater_every, c.densify_until),
                stray_sigmas=c.floater_sigmas,
                prune_large_from=c.prune_large_from,
                largest=LargestGaussian(c.prune_scale, c.prune_radius, c.prune_radius_px),
            )
        )

    def own_losses(self, batch: ViewBatch, drawn: Drawn, step: int) -> dict[str, Tensor]:
        c = self.config
        if not c.depth_weight or batch.mono_depth is None or not batch.mask_known:
            return {}
        object_mask = batch.mask if batch.weight is None else batch.mask * batch.weight
        depth = disparity_loss(drawn.render.depth, drawn.render.alpha, batch.mono_depth, object_mask)
        return {} if depth is None else {"depth": c.depth_weight * depth}
