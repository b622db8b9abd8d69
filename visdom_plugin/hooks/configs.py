"""Settings of the hooks. Free of heavy imports, so that command lines can show them at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.validation import demand

if TYPE_CHECKING:
    from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer
    from visdom_plugin.hooks.sampler import VisDomSampler
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Views


@dataclass(frozen=True)
class SamplerConfig:
    """Settings of VisDomSampler: a band around the hull outside which no samples are taken."""

    enabled: bool = False
    """Whether the hook takes part at all; off leaves the base method unchanged."""
    epsilon_camera_distances: float = 0.03
    """Half width of the band, in mean distances from the training cameras to the hull's centre (the paper's 0.2
    for cameras at distance 1)."""
    epsilon_hull_radii: float | None = None
    """The same in radii of the hull, in place of camera distances."""
    epsilon_world: float | None = None
    """The same in units of the scene; give one of these two."""
    interval: Literal["first_hit", "entry_exit"] = "entry_exit"
    """Around the first hit, as the paper writes, or from before the first to behind the last."""
    missing: Literal["full", "skip"] = "full"
    """Rays that miss the hull: sampled over the method's full range, or not at all."""
    hull_at_inference: bool = False
    """Novel views, too, are sampled inside the band only, and rays that miss show the background."""
    drop_outside: bool = False
    """Of the samples in the band, those at points outside the hull count nothing (VaxNeRF; Instant-NGP only)."""

    def build(self, hull: Hull, views: Views) -> VisDomSampler:
        """The hook for one hull, and the training views whose mean distance is the unit."""
        from visdom_plugin.hooks.sampler import VisDomSampler

        return VisDomSampler(hull, self, cameras=views.cameras)


@dataclass(frozen=True)
class RegularizerConfig:
    """Settings of VisDomGaussianRegularizer: points to start from, and the loss L_i on views between cameras."""

    enabled: bool = False
    """Whether the hook takes part at all; off leaves the base method unchanged."""
    weight: float = 0.01
    """lambda_3, the weight of L_i (the paper's value)."""
    every: int = 1
    """Add L_i on every n-th step."""
    start: int = 0
    """First step with L_i."""
    views_per_step: int = 1
    """Interpolated views per loss."""
    bank: int = 64
    """Views to draw from, made once, so that the hull's silhouette is cast once for each; 0 draws a new view
    every time."""
    points: Literal["surface", "volume"] = "volume"
    """Where initial points lie: on the hull's surface, or anywhere inside it, where the object is."""
    prune_every: int = 50
    """Remove Gaussians whose centres lie outside the hull on every n-th step; 0 leaves them to L_i."""
    prune_margin_voxels: float = 2.0
    """How far outside the hull a centre may lie before it is removed, in voxels of the hull's grid."""

    def build(self, hull: Hull, views: Views) -> VisDomGaussianRegularizer:
        """The hook for one hull and the training views whose colours the initial points take."""
        from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer

        return VisDomGaussianRegularizer(hull, views.cameras, self, images=views.images)


@dataclass(frozen=True, kw_only=True)
class MethodConfig:
    """The settings in which a method's variants differ; a method's own config inherits one of the two below."""

    mask_weight: float = 0.0
    """Weight of the binary cross entropy between rendered opacity and mask."""
    hull: VisibleDomain | None = None
    """The hull of the visible-domain hook; carved when there is one."""

    def __post_init__(self) -> None:
        demand(self, {"mask_weight": (self.mask_weight >= 0, "0 or more")})


@dataclass(frozen=True, kw_only=True)
class SamplerMethodConfig(MethodConfig):
    """Settings of a method that takes rays' bounds from VisDomSampler."""

    vd: SamplerConfig = field(default_factory=SamplerConfig)
    """The visible-domain hook."""
    drops_samples: ClassVar[bool] = False
    """Whether the method asks the hook's `keep` about each sample; without, `vd.drop_outside` is refused."""

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"{type(self).__name__}, --method.vd"
        if self.hull is None and (self.vd.enabled or self.vd.hull_at_inference):
            raise ConfigError(
                "the visible-domain hook is asked for, but no hull to go with it",
                where=where,
                todo="start from the variant +vd, which has both",
            )
        if self.vd.drop_outside and not self.drops_samples:
            raise ConfigError(
                "vd.drop_outside is on, but the method does not say that it drops single samples",
                where=f"{where}.drop-outside",
                todo="leave it off, or train method:vaxnerf; a method that asks the hook's keep() about each "
                "sample says so in its config: drops_samples: ClassVar[bool] = True",
            )


@dataclass(frozen=True, kw_only=True)
class GaussianMethodConfig(MethodConfig):
    """Settings of a method that takes points and losses from VisDomGaussianRegularizer."""

    vd: RegularizerConfig = field(default_factory=RegularizerConfig)
    """The visible-domain hook."""
