"""A method's part of the hooks: their settings with a switch, and the config fields that go with them.

Hooks are made here of settings, and imported only then, so that command lines can show the settings at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.settings import RegularizerSettings, SamplerSettings
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.validation import demand

if TYPE_CHECKING:
    from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer
    from visdom_plugin.hooks.sampler import VisDomSampler
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Views


@dataclass(frozen=True)
class SamplerConfig(SamplerSettings):
    """Settings of VisDomSampler: a band around the hull outside which no samples are taken."""

    enabled: bool = False
    """Whether the hook takes part at all; off leaves the base method unchanged."""

    def build(self, hull: Hull, views: Views) -> VisDomSampler:
        """The hook for one hull, and the training views whose mean distance is the unit."""
        from visdom_plugin.hooks.sampler import VisDomSampler

        return VisDomSampler(hull, self, cameras=views.cameras)


@dataclass(frozen=True)
class RegularizerConfig(RegularizerSettings):
    """Settings of VisDomGaussianRegularizer: points to start from, and the loss L_i on views between cameras."""

    enabled: bool = False
    """Whether the hook takes part at all; off leaves the base method unchanged."""
    loss_hull: VisibleDomain | None = None
    """The hull that L_i goes by, carved for it; by default the method's own. The VisDom authors' release has two:
    Gaussians start in one, L_i looks at the other."""

    def build(self, hull: Hull, views: Views) -> VisDomGaussianRegularizer:
        """The hook for one hull and the training views whose colours the initial points take."""
        from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer

        other = None if self.loss_hull is None else self.loss_hull.carve(*views.silhouettes())
        return VisDomGaussianRegularizer(hull, views.cameras, self, images=views.images, loss_hull=other)


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
    trains_empty_rays: ClassVar[bool] = False
    """Whether the method trains the hook's `empty_rays`; without, `vd.virtual_views` is refused."""

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
        if self.vd.virtual_views != "none" and not self.trains_empty_rays:
            raise ConfigError(
                "vd.virtual_views is on, but the method does not say that it trains their rays",
                where=f"{where}.virtual-views",
                todo="leave it off; a method that adds the loss on the hook's empty_rays() (see hooks.protocols."
                "EmptySpace) says so in its config: trains_empty_rays: ClassVar[bool] = True",
            )


@dataclass(frozen=True, kw_only=True)
class GaussianMethodConfig(MethodConfig):
    """Settings of a method that takes points and losses from VisDomGaussianRegularizer."""

    vd: RegularizerConfig = field(default_factory=RegularizerConfig)
    """The visible-domain hook."""
