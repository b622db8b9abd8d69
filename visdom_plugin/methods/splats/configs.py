"""Settings of the splatting methods: plain data, free of heavy imports. Defaults are the published schedules."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.splat.set_config import GaussianSetConfig
from visdom_plugin.validation import demand


@dataclass(frozen=True)
class HullStartConfig(GaussianSetConfig):
    """What all methods of Gaussians take: where they start, what helps at few views, the visible-domain hook."""

    hull: VisibleDomain | None = field(default_factory=lambda: VisibleDomain(kind="released-go"))
    """Where the Gaussians start; None for the points of structure from motion, where the scene has them."""
    initial_shape: Literal["hull", "inside"] = "hull"
    """Whether they start in the hull itself or in the smoothest full shape inside it that has its silhouettes. The
    hull stays what the hook's loss, the removal of Gaussians and the metrics go by."""
    inside: InsideConfig = field(default_factory=InsideConfig)
    """How that shape is found."""
    virtual_weight: float = 0.0
    """Weight of the mean absolute difference, in a view between two training cameras, to the photographs warped
    over that shape (over the hull where it is not asked for); beside it nothing is to be seen."""
    dropout: float = 0.0
    """Share of the Gaussians that a step leaves out at random, grown linearly to this value at the end; the others
    are the more opaque for it (Park et al., DropGaussian, CVPR 2025)."""
    colour_correction: bool = False
    """Fit an affine map of colours to each training view, for captures whose exposure or white balance changes;
    novel views have the colours of the average one."""
    vd: RegularizerConfig = field(default_factory=RegularizerConfig)
    """The visible-domain hook; of two sets of Gaussians each has its loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        shapeless = self.virtual_weight > 0 and self.hull is None
        demand(
            self,
            {
                "virtual_weight": (
                    self.virtual_weight >= 0 and not shapeless,
                    "0, or more where there is a hull",
                ),
                "dropout": (0 <= self.dropout < 1, "a share of at least 0, below 1"),
            },
        )


@dataclass(frozen=True)
class GsGoConfig(HullStartConfig):
    """3DGS-GO: the coarse stage of GaussianObject (Yang et al. 2024), without its diffusion repair."""

    steps: int = 10_000
    """Optimisation steps, one training view each."""
    sh_degree: int = 2
    """Highest degree of the spherical harmonics, 0 to 3."""
    mask_weight: float = 0.01
    """lambda_2, binary cross entropy between rendered opacity and mask."""
    lr_means_steps: int = 30_000
    """GaussianObject keeps 3DGS's 30,000 although it runs 10,000."""
    densify_until: int = 6_000
    """Step at which cloning, splitting and pruning ends."""

    depth_weight: float = 0.0005
    """Shift- and scale-free L1 on disparities, where the scene comes with monocular depth."""

    prune_large_from: int = 1_000
    """From here on Gaussians too large on screen or in space are removed."""
    prune_radius: float = 0.025
    """Fraction of the picture's longer side: 3DGS's 20 pixels at 800."""
    prune_radius_px: float | None = None
    """The same in pixels; wins over the fraction."""
    prune_scale: float = 0.1
    """Fraction of the extent."""
    opacity_reset_every: int = 1_000
    """Until `densify_until`, opacities fall to 0.01 on every n-th step; 0 never."""

    floater_every: int = 500
    """Until `densify_until`, statistical removal of stray Gaussians on every n-th step; 0 never."""
    floater_sigmas: tuple[float, float] = (1.0, 2.326)
    """Its threshold in standard deviations, from the first to the last removal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        not_negative = ("depth_weight", "prune_large_from", "opacity_reset_every", "floater_every")
        positive = ("prune_radius", "prune_scale")
        radius_px = self.prune_radius_px
        demand(
            self,
            {name: (getattr(self, name) >= 0, "0 or more") for name in not_negative}
            | {name: (getattr(self, name) > 0, "a positive number") for name in positive}
            | {
                "prune_radius_px": (radius_px is None or radius_px > 0, "a positive number, or None"),
                "floater_sigmas": (min(self.floater_sigmas) >= 0, "numbers of 0 or more"),
            },
        )


@dataclass(frozen=True)
class CorgsConfig(HullStartConfig):
    """CoR-GS (Zhang et al. 2024): two sets of Gaussians that check each other.

    Defaults are the authors' for captures all round a scene (their script for mip-NeRF 360), where they say them.
    """

    sh_every: int = 500
    """Steps between two degrees; training starts at degree 0."""
    densify_gradient: float = 0.0005
    """Mean norm of the loss's gradient by the projected mean, in normalised device units (image = [-1, 1])."""
    opacity_reset_from: int = 501
    """First step after which opacities fall to 0.01."""
    opacity_reset_every: int = 3_000
    """Again on every n-th step after that, to the end; 0 never."""

    initial_cloud: Literal["hull", "random"] = "hull"
    """Where both sets start: in the hull, or in a box around what the cameras look at. The authors' dense cloud
    of COLMAP needs more than photographs with poses. The visible-domain hook brings its own points."""

    pseudo_views: Literal["ellipse", "between"] = "ellipse"
    """Unseen views in which the sets are compared: on an ellipse fitted to the cameras, or between two of them."""
    pseudo_from: int = 500
    """First step with a pseudo view."""
    pseudo_until: int = 30_000
    """Last step with a pseudo view."""
    pseudo_every: int = 1
    """A pseudo view on every n-th step; 0 never."""
    pseudo_weight: float = 1.0
    """Of the image loss of each set's pseudo view towards the other set's."""

    co_prune_every: int = 500
    """After `densify_from`, Gaussians without a neighbour in the other set are removed on every n-th step; 0
    never."""
    co_prune_extents: float = 0.05
    """How far the nearest neighbour may be, as a fraction of the scene extent. Much less than the default eats
    thin parts; much more never meets a stray near the object."""
    co_prune_world: float | None = None
    """The same in units of the scene; wins over the fraction. The authors: 20 for mip-NeRF 360, 10 for DTU, 5 for
    LLFF, in the units COLMAP happened to choose."""

    def __post_init__(self) -> None:
        super().__post_init__()
        not_negative = (
            "opacity_reset_from",
            "opacity_reset_every",
            "pseudo_from",
            "pseudo_until",
            "pseudo_every",
            "pseudo_weight",
            "co_prune_every",
        )
        world = self.co_prune_world
        demand(
            self,
            {name: (getattr(self, name) >= 0, "0 or more") for name in not_negative}
            | {
                "co_prune_extents": (self.co_prune_extents > 0, "a positive number"),
                "co_prune_world": (world is None or world > 0, "a positive number, or None"),
            },
        )
