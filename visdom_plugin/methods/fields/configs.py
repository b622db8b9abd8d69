"""Settings of the radiance fields: plain data, free of heavy imports. Defaults are the published schedules."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from visdom_plugin.hooks.configs import SamplerMethodConfig
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.validation import demand


@dataclass(frozen=True, kw_only=True)
class FieldConfig(SamplerMethodConfig):
    """What all radiance fields take."""

    prior_weight: float = 0.0
    """Weight of the mean opacity in the hull beside the smoothest full shape inside it that has its silhouettes, a
    soft prior that space is empty there. Needs a hull."""
    inside: InsideConfig = field(default_factory=InsideConfig)
    """How that shape is found."""
    colour_correction: bool = False
    """Fit an affine map of colours to each training view, for captures whose exposure or white balance changes;
    novel views have the colours of the average one."""
    trains_empty_rays: ClassVar[bool] = True
    few_views: int = 4
    """Up to how many training views are few, for `few_views_share`."""
    few_views_share: float = 1.0
    """Share of the schedule after which training stops where there are few training views. The VisDom authors'
    release stops Zip-NeRF at 6,000 of 25,000 steps with 4 views."""

    def __post_init__(self) -> None:
        super().__post_init__()
        shapeless = self.prior_weight > 0 and self.hull is None
        fits = self.prior_weight >= 0 and not shapeless
        demand(
            self,
            {
                "prior_weight": (fits, "0, or more where there is a hull, as in the variant +vd"),
                "few_views": (self.few_views >= 0, "0 or more"),
                "few_views_share": (0 < self.few_views_share <= 1, "a share above 0, at most 1"),
            },
        )


@dataclass(frozen=True)
class IngpConfig(FieldConfig):
    """Instant-NGP (Müller et al. 2022). Lengths are in mean camera distances unless their name says otherwise.

    The field fills the cube of half side `half_side` around the training cameras' look-at point.
    """

    steps: int = 20_000
    """Optimisation steps, one batch of pixels each."""
    max_rays: int = 8_192
    """Pixels per step, at most."""
    samples_per_step: int = 1 << 18
    """Pixels per step are chosen so that this many samples result (nerfacc, Instant-NGP)."""
    background: Literal["white", "random"] = "white"
    """Behind the photograph in training. Random colours need the masks as alpha: a silhouette signal."""

    half_side: float = 1.0
    near: float = 0.05
    step_length: float = 0.004
    """Between two samples of a ray, where the occupancy grid leaves any."""
    missing_step_length: float = 0.032
    """The same for rays that miss the hull, with the visible-domain hook: they only clear space."""

    grid: HashLayout = field(
        default_factory=lambda: HashLayout(16, 2, base_resolution=16, max_resolution=2048, log2_table_size=19)
    )
    hidden: int = 64
    """Width of both networks' hidden layers: one for density, two for colour."""
    geometry_features: int = 15
    """Numbers handed from the density network to the colour network."""
    view_degree: int = 4
    """Spherical harmonics of the viewing direction that colours may depend on: degree^2 numbers, 0 none."""
    density_bias: float = -1.0
    """density = exp(x + bias), per camera distance."""

    occupancy_resolution: int = 128
    occupancy_every: int = 16
    """Steps between two updates of the occupancy grid."""
    occupancy_warm_up: int = 256
    """Until this step, updates look at all cells; later at a quarter, and at as many occupied ones."""
    occupancy_fraction: float = 0.25
    occupancy_alpha: float = 0.01
    """Cells whose density gives less opacity than this over one step length are skipped."""
    drop_unsampled: bool = True
    """Cells that no training ray samples, given its bounds, stay empty for ever (Instant-NGP: that none sees)."""

    lr: float = 0.01
    lr_warm_up: int = 100
    lr_factor: float = 0.33
    """The learning rate falls by this factor at 50, 75 and 90 % of the schedule (nerfacc)."""
    weight_decay: float = 1e-6
    """Of the networks, not of the hash table."""

    drops_samples: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = ("half_side", "step_length", "missing_step_length", "lr", "occupancy_alpha")
        counts = (
            "max_rays",
            "samples_per_step",
            "hidden",
            "geometry_features",
            "occupancy_resolution",
            "occupancy_every",
        )
        demand(
            self,
            {name: (getattr(self, name) > 0, "a positive number") for name in positive}
            | {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {
                "steps": (self.steps >= 0, "0 or more"),
                "near": (self.near >= 0, "0 or more"),
                "view_degree": (0 <= self.view_degree <= 4, "0 to 4"),
                "occupancy_fraction": (0 < self.occupancy_fraction <= 1, "a share above 0, at most 1"),
            },
        )


@dataclass(frozen=True)
class ZipNerfConfig(FieldConfig):
    """Zip-NeRF (Barron et al. 2023) on one device. Lengths are in mean camera distances.

    Defaults are the published ones for a single GPU (camp_zipnerf).
    """

    steps: int = 200_000
    """Optimisation steps, one batch of pixels each."""
    rays: int = 8_192
    """Pixels per step."""
    background: Literal["white", "random"] = "white"
    """Behind the photograph in training. Random colours need the masks as alpha: a silhouette signal."""

    near: float = 0.05
    far: float = 1e6
    """Space beyond the cameras is contracted into a ball of radius 2."""
    spacing_power: float = -1.5
    """Of the power ladder along which samples are spaced (Zip-NeRF: short steps near the camera, long ones far
    from it). 1 is even spacing, as in the VisDom authors' release."""
    samples: tuple[int, int, int] = (64, 64, 32)
    """Intervals per ray: two proposals, then the field itself."""
    test_samples: tuple[int, int, int] | None = None
    """The same when rendering; by default as in training."""

    coarse_grid: HashLayout = field(
        default_factory=lambda: HashLayout(6, 1, base_resolution=16, max_resolution=512, log2_table_size=21)
    )
    """Of the first proposal."""
    fine_grid: HashLayout = field(
        default_factory=lambda: HashLayout(8, 1, base_resolution=16, max_resolution=2048, log2_table_size=21)
    )
    """Of the second proposal."""
    grid: HashLayout = field(
        default_factory=lambda: HashLayout(10, 4, base_resolution=16, max_resolution=8192, log2_table_size=21)
    )
    """Of the field."""
    hidden: int = 64
    """Width of the density networks' one hidden layer."""
    bottleneck: int = 256
    """Numbers handed from the density network to the colour network."""
    colour_hidden: int = 256
    colour_layers: int = 3
    """Hidden layers of the colour network; its input joins again before the last of them."""
    view_degree: int = 4
    """Octaves of sines of the viewing direction that colours may depend on."""
    density_bias: float = -1.0
    """density = exp(x + bias), per camera distance."""

    interlevel_weight: float = 0.01
    distortion_weight: float = 0.01
    hash_decay: float = 0.1
    """Times the mean squares of the tables, summed over levels and grids."""
    blur: tuple[float, float] = (0.03, 0.003)
    """Half widths of the interlevel loss, in normalised distance."""
    anneal_slope: float = 10.0
    proposal_mask_share: float = 0.0
    """What the silhouette loss of each proposal weighs, as a share of the field's; 0.1 in the release."""
    mask_clamp: float = 1e-6
    """The silhouette loss takes opacity, and mask, to be at least this far from 0 and 1; 0.001 in the release.
    Nearer there is no gradient: a field that starts emptier may stay empty."""

    lr: float = 0.00125
    lr_final: float = 0.000125
    lr_warm_up: int = 20_000
    lr_delay: float = 1e-8

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = ("rays", "hidden", "bottleneck", "colour_hidden", "colour_layers")
        weights = ("interlevel_weight", "distortion_weight", "hash_decay")
        positive = ("lr", "lr_final", "anneal_slope")
        demand(
            self,
            {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {name: (getattr(self, name) >= 0, "0 or more") for name in weights}
            | {name: (getattr(self, name) > 0, "a positive number") for name in positive}
            | {
                "steps": (self.steps >= 0, "0 or more"),
                "near": (self.near >= 0, "0 or more"),
                "far": (self.far > self.near, f"more than near, {self.near}"),
                "samples": (min(self.samples) >= 2, "2 or more for each level"),
                "test_samples": (min(self.test_samples or (2,)) >= 2, "2 or more for each level"),
                "spacing_power": (self.spacing_power != 0, "any number but 0"),
                "proposal_mask_share": (self.proposal_mask_share >= 0, "0 or more"),
                "mask_clamp": (0 < self.mask_clamp < 0.5, "a number above 0, below 0.5"),
                "blur": (min(self.blur) > 0, "positive numbers"),
                "view_degree": (self.view_degree >= 0, "0 or more"),
            },
        )
