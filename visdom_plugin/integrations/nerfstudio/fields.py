"""Nerfacto and Instant-NGP of nerfstudio, confined to the visible domain.

What is added to the method, and nothing else: the hull bounds the rays that train (a collider), opacity follows
the masks (a loss), and training shows photographs on random colours with the masks as alpha (nerfstudio's way).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.model_components.scene_colliders import NearFarCollider, SceneCollider
from nerfstudio.models.base_model import Model
from nerfstudio.models.instant_ngp import InstantNGPModelConfig, NGPModel
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import EmptySpace, SamplerHook, empty_spaces
from visdom_plugin.hull.domain import TRAINING_DOMAIN, VisibleDomain
from visdom_plugin.integrations.nerfstudio.dataparser import METADATA, told
from visdom_plugin.integrations.nerfstudio.frame import Similarity
from visdom_plugin.integrations.nerfstudio.pictures import TrainingViews
from visdom_plugin.integrations.nerfstudio.rays import bound_model_rays
from visdom_plugin.losses import mask_loss

SAMPLER = SamplerConfig(enabled=True)


class HullCollider(SceneCollider):
    """The method's own bounds, then the hull's: in training, or always with `at_inference`.

    Args:
        own: the method's collider.
        hook: lives in the world frame.
        frame: the model's frame.
    """

    def __init__(self, own: SceneCollider, hook: SamplerHook, frame: Similarity, at_inference: bool = False):
        super().__init__()
        self.own, self.hook, self.frame, self.at_inference = own, hook, frame, at_inference

    def set_nears_and_fars(self, ray_bundle: RayBundle) -> RayBundle:
        """Fills in `nears` and `fars` (..., 1), in model units along the ray."""
        bundle = self.own(ray_bundle)
        if self.training or self.at_inference:
            bounds = bound_model_rays(
                self.hook,
                self.frame,
                bundle.origins,
                bundle.directions,
                bundle.nears[..., 0],
                bundle.fars[..., 0],
            )
            bundle.nears, bundle.fars = bounds.near[..., None], bounds.far[..., None]
        return bundle


class RandomThenWhite(RGBRenderer):
    """Random colours behind photograph and render in training, white in pictures and metrics."""

    @property
    def background_color(self) -> str:
        """A name that nerfstudio knows."""
        return "random" if self.training else "white"

    @background_color.setter
    def background_color(self, value: object) -> None:
        """Nerfstudio's constructor sets it."""


def known_views(metadata: dict[str, object] | None, method: str) -> TrainingViews:
    """The training views that the data parser handed on.

    Raises:
        ConfigError: for another data parser than ours.
    """
    known = (metadata or {}).get(METADATA)
    if not isinstance(known, TrainingViews):
        raise ConfigError(
            f"{method} needs foreground masks, and this data parser hands on none",
            todo=f"use ours: ns-train {method} visdom --data DIR",
            topic="mask-missing",
        )
    return known


def rgba_mask_loss(accumulation: Tensor, image: Tensor) -> Tensor:
    """Binary cross entropy between opacity (n, 1) and the alpha channel of the photographs' pixels (n, 4).

    Raises:
        ConfigError: for photographs without an alpha channel.
    """
    if image.shape[-1] != 4:
        raise ConfigError(
            "the mask loss needs masks, and these photographs come without",
            where="--pipeline.model.mask-weight",
            todo="pass `visdom --background alpha`, or set the weight to 0",
            topic="mask-missing",
        )
    # Nerfstudio trains in mixed precision, where torch refuses this loss.
    with torch.autocast(accumulation.device.type, enabled=False):
        return mask_loss(accumulation[..., 0].float(), image[..., 3].to(accumulation.device).float())


def zero_opacity_loss(accumulation: Tensor) -> Tensor:
    """Binary cross entropy between opacity (n, 1) and 0."""
    with torch.autocast(accumulation.device.type, enabled=False):
        alpha = accumulation[..., 0].float()
        return mask_loss(alpha, torch.zeros_like(alpha))


class _HullField(Model):
    """What both methods get; stands before the model's own class."""

    method: str
    collider: SceneCollider | None

    def populate_modules(self) -> None:
        super().populate_modules()
        config = self.config
        if config.background_color == "random":
            self.renderer_rgb = RandomThenWhite()
        if not config.vd.enabled:
            return
        with told():
            if config.vd.drop_outside:
                raise ConfigError(
                    "nerfstudio's methods bound rays, they do not drop single samples",
                    where="--pipeline.model.vd.drop-outside",
                    todo="leave it off; --pipeline.model.vd.hull-at-inference True draws inside the band only",
                )
            known = known_views(self.kwargs.get("metadata"), self.method)
            hull = config.hull.carve(*known.views.silhouettes())
            hook = config.vd.build(hull, known.views)
        own = self.collider or NearFarCollider(config.near_plane, config.far_plane)
        self.collider = HullCollider(own, hook, known.frame, config.vd.hull_at_inference)

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self.config.mask_weight > 0:
            with told():
                loss = rgba_mask_loss(outputs["accumulation"], batch["image"].to(self.device))
            losses["mask_loss"] = self.config.mask_weight * loss
        if self.training and isinstance(self.collider, HullCollider):
            for hook in empty_spaces([self.collider.hook]):
                alpha = self._opacity_of_nothing(hook, len(outputs["accumulation"]))
                if len(alpha):
                    losses["empty_loss"] = hook.virtual_weight * zero_opacity_loss(alpha)
        return losses

    def _opacity_of_nothing(self, hook: EmptySpace, photographed: int) -> Tensor:
        """(n, 1) along rays of empty space, sampled between the method's own bounds; n may be 0."""
        assert isinstance(self.collider, HullCollider)
        rays = hook.empty_rays(photographed, device=self.device)
        if not len(rays.origins):
            return rays.radii[:, None]
        frame = self.collider.frame
        bundle = RayBundle(
            origins=frame.points_to_model(rays.origins),
            directions=frame.directions_to_model(rays.directions),
            # Of a square as large as the pixel, whose radius is 2 / sqrt(12) of its side.
            pixel_area=(3 * rays.radii.square())[:, None],
            # No colour is looked at, so any photograph's appearance will do.
            camera_indices=torch.zeros_like(rays.radii[:, None], dtype=torch.int64),
        )
        return self.get_outputs(self.collider.own(bundle))["accumulation"]


@dataclass
class NerfactoVdConfig(NerfactoModelConfig):
    """Nerfacto with rays confined to the visible domain."""

    _target: type = field(default_factory=lambda: NerfactoVd)
    background_color: Literal["random", "last_sample", "black", "white"] = "random"
    """Behind photographs in training; pictures and metrics are on white with "random"."""
    mask_weight: float = 0.1
    """Weight of the cross entropy between opacity and mask."""
    hull: VisibleDomain = TRAINING_DOMAIN
    """How the hull is carved from the training views' masks."""
    vd: SamplerConfig = SAMPLER
    """The visible-domain hook."""


class NerfactoVd(_HullField, NerfactoModel):
    """Nerfacto, confined."""

    config: NerfactoVdConfig
    method = "nerfacto-vd"


@dataclass
class InstantNgpVdConfig(InstantNGPModelConfig):
    """Instant-NGP with rays confined to the visible domain."""

    _target: type = field(default_factory=lambda: InstantNgpVd)
    mask_weight: float = 0.1
    """Weight of the cross entropy between opacity and mask."""
    hull: VisibleDomain = TRAINING_DOMAIN
    """How the hull is carved from the training views' masks."""
    vd: SamplerConfig = SAMPLER
    """The visible-domain hook."""


class InstantNgpVd(_HullField, NGPModel):
    """Instant-NGP, confined: its sampler reads the bounds that the collider sets."""

    config: InstantNgpVdConfig
    method = "instant-ngp-vd"
