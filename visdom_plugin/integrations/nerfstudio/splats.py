"""Splatfacto of nerfstudio, starting from the hull, with the loss L_i, and without Gaussians outside.

Nerfstudio's splatfacto runs on CUDA alone. What is computed here is the same on any device.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from gsplat.strategy.ops import remove
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hooks.protocols import Means
from visdom_plugin.hull.domain import TRAINING_DOMAIN, VisibleDomain
from visdom_plugin.integrations.nerfstudio.dataparser import host_cameras, told
from visdom_plugin.integrations.nerfstudio.fields import known_views, rgba_mask_loss

REGULARIZER = RegularizerConfig(enabled=True)


@dataclass
class SplatfactoVdConfig(SplatfactoModelConfig):
    """Splatfacto that starts from the hull and stays inside."""

    _target: type = field(default_factory=lambda: SplatfactoVd)
    initial_points: int = 20_000
    """Gaussians at the start, drawn from the hull."""
    mask_weight: float = 0.1
    """Weight of the cross entropy between opacity and mask."""
    hull: VisibleDomain = TRAINING_DOMAIN
    """How the hull is carved from the training views' masks."""
    vd: RegularizerConfig = REGULARIZER
    """The visible-domain hook."""


class SplatfactoVd(SplatfactoModel):
    """Splatfacto, confined."""

    config: SplatfactoVdConfig
    method = "splatfacto-vd"
    _full_size = False

    def populate_modules(self) -> None:
        self.hook = None
        if self.config.vd.enabled:
            with told():
                known = known_views(self.kwargs.get("metadata"), self.method)
                hull = self.config.hull.carve(*known.views.silhouettes())
                self.hook, self.frame = self.config.vd.build(hull, known.views), known.frame
            xyz, rgb = self.hook.initial_points(self.config.initial_points, torch.Generator().manual_seed(0))
            # Nerfstudio's colours of points go to 255.
            self.seed_points = self.frame.points_to_model(xyz).float(), 255 * rgb
        super().populate_modules()
        # Training shows random colours; nerfstudio would draw pictures and metrics on a dark grey.
        if self.config.background_color == "random":
            self.background_color = torch.ones(3)

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if not self.training:
            return losses
        if self.config.mask_weight > 0:
            with told():
                loss = rgba_mask_loss(outputs["accumulation"], self.get_gt_img(batch["image"]))
            losses["mask_loss"] = self.config.mask_weight * loss
        if self.hook is not None:
            # A generator of the step's own, so that resumed runs draw the same views.
            losses |= self.hook.loss(self.render_opacity, self.step, torch.Generator().manual_seed(self.step))
        return losses

    def render_opacity(self, camera: Cameras) -> Tensor:
        """Opacity (H, W) in one of our cameras, at its full size, with gradients, without traces in the model."""
        with self._aside():
            outputs = self.get_outputs(host_cameras(camera_batch(camera), self.frame).to(self.device))
        return outputs["accumulation"][..., 0]

    @contextlib.contextmanager
    def _aside(self) -> Iterator[None]:
        # Densification reads what the last render of a photograph left in `info`.
        kept = {name: self.__dict__.get(name) for name in ("info", "last_size")}
        self._full_size = True
        try:
            yield
        finally:
            self._full_size = False
            self.__dict__.update(kept)

    def _get_downscale_factor(self) -> int:
        return 1 if self._full_size else super()._get_downscale_factor()

    def get_training_callbacks(self, training_callback_attributes) -> list[TrainingCallback]:
        callbacks = super().get_training_callbacks(training_callback_attributes)
        prune = TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self.prune_outside)
        return [*callbacks, prune] if self.hook is not None else callbacks

    def prune_outside(self, step: int) -> None:
        """Removes Gaussians outside the hull, with their part of the optimisers and of the strategy's state."""
        world = Means(self.frame.points_to_world(self.means.detach()))
        outside = None if self.hook is None else self.hook.after_step(world, step)
        if outside is None or not bool(outside.any()) or bool(outside.all()):
            return
        remove(self.gauss_params, self.optimizers, self.strategy_state, outside)


def camera_batch(camera: Cameras) -> Cameras:
    """One camera, shape (), as a batch (1,)."""
    return Cameras(
        *(x[None] for x in (camera.intrinsics, camera.world_from_camera, camera.width, camera.height))
    )
