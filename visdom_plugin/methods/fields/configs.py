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
    """Half the side of the cube that the field fills."""
    near: float = 0.05
    """Distance from the camera at which rays begin."""
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
    """Cells of the occupancy grid along each axis."""
    occupancy_every: int = 16
    """Steps between two updates of the occupancy grid."""
    occupancy_warm_up: int = 256
    """Until this step, updates look at all cells; later at a quarter, and at as many occupied ones."""
    occupancy_fraction: float = 0.25
    """Share of all cells that an update looks at after the warm-up."""
    occupancy_alpha: float = 0.01
    """Cells whose density gives less opacity than this over one step length are skipped."""
    drop_unsampled: bool = True
    """Cells that no training ray samples, given its bounds, stay empty for ever (Instant-NGP: that none sees)."""

    lr: float = 0.01
    """Learning rate."""
    lr_warm_up: int = 100
    """Steps in which the learning rate rises to its full value."""
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
    """Distance from the camera at which rays begin."""
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
    """Width of the colour network's hidden layers."""
    colour_layers: int = 3
    """Hidden layers of the colour network; its input joins again before the last of them."""
    view_degree: int = 4
    """Octaves of sines of the viewing direction that colours may depend on."""
    density_bias: float = -1.0
    """density = exp(x + bias), per camera distance."""

    interlevel_weight: float = 0.01
    """Of the loss that pulls the proposals' weights towards the field's."""
    distortion_weight: float = 0.01
    """Of the loss that gathers the weights along a ray (mip-NeRF 360)."""
    hash_decay: float = 0.1
    """Times the mean squares of the tables, summed over levels and grids."""
    blur: tuple[float, float] = (0.03, 0.003)
    """Half widths of the interlevel loss, in normalised distance."""
    anneal_slope: float = 10.0
    """How fast proposals sharpen over the schedule (mip-NeRF 360)."""
    proposal_mask_share: float = 0.0
    """What the silhouette loss of each proposal weighs, as a share of the field's; 0.1 in the release."""
    mask_clamp: float = 1e-6
    """The silhouette loss takes opacity, and mask, to be at least this far from 0 and 1; 0.001 in the release.
    Nearer there is no gradient: a field that starts emptier may stay empty."""

    lr: float = 0.00125
    """Learning rate."""
    lr_final: float = 0.000125
    """Learning rate at the end, reached log-linearly."""
    lr_warm_up: int = 20_000
    """Steps in which the learning rate rises to its full value."""
    lr_delay: float = 1e-8
    """Share of the learning rate with which the warm-up begins."""

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


@dataclass(frozen=True)
class ZeroRfConfig(FieldConfig):
    """ZeroRF (Shi et al. 2023). Lengths are in half sides of the cube [-1, 1]^3 that is fitted to the object.

    Defaults are the published ones, except for the marching step, which there grows with the distance.
    """

    steps: int = 10_000
    """Optimisation steps, one batch of pixels each."""
    first_rays: int = 1 << 12
    """Pixels per step before the first of `rays_grow_at`; then the geometric mean of this and `rays`."""
    rays: int = 1 << 16
    """Pixels per step from the second of `rays_grow_at` on."""
    rays_grow_at: tuple[int, int] = (50, 100)
    """Steps at which the number of pixels per step grows."""
    background: Literal["white", "random"] = "white"
    """Behind the photograph in training. Random colours need the masks as alpha: a silhouette signal."""
    compare_alpha: bool = True
    """Let the mean squared error compare opacity with the mask as a fourth channel, as the original does where
    photographs come with alpha. False compares colours alone."""
    mse_weight: float = 3.2
    """Of the mean squared error."""

    fit_margin: float = 0.1
    """Room around the object in the cube, as a share of its half side."""
    near: float = 0.2
    """Distance from the camera at which rays begin."""
    step_length: float = 0.0034
    """Between two samples of a ray, where the occupancy grid leaves any."""
    missing_step_length: float = 0.027
    """The same for rays that miss the hull, with the visible-domain hook: they only clear space."""
    cull_weight: float = 1e-4
    """Training samples that weigh less than this in their pixel are left out."""

    representation: Literal["tensorf", "dif"] = "tensorf"
    """tensorf: three planes, each times the line across it. dif: two volumes, one of which repeats."""
    dif_period: float = 0.4
    """After which the second volume of "dif" repeats; the original calls it a frequency."""
    noise_channels: int = 8
    """Channels of the frozen noise."""
    noise_resolution: int = 20
    """Along each side of the frozen noise: about a fortieth of the photographs' pixels. Planes and lines are 16
    times as fine, volumes 8 times."""
    channels: int = 16
    """Features of each plane, line or volume."""
    width: int = 32
    """Channels of the generating networks' finest level; coarser ones have up to eight times as many."""
    hidden: int = 64
    """Width of the one hidden layer between features and density or colour."""
    view_degree: int = 3
    """Spherical harmonics of the viewing direction that colours may depend on: degree^2 numbers, 0 none."""
    density_bias: float = 0.0
    """density = exp(x + bias), per half side."""

    occupancy_resolution: int = 64
    """Cells of the occupancy grid along each axis."""
    occupancy_every: int = 1
    """Steps between two updates of the occupancy grid."""
    occupancy_warm_up: int = 0
    """Until this step, updates look at all cells; later at `occupancy_fraction`, and at as many occupied ones."""
    occupancy_fraction: float = 1.0
    """Share of all cells that an update looks at after the warm-up."""
    occupancy_density: float = 0.05
    """Cells with less density than this, and than the mean, are skipped in training."""
    test_occupancy_density: float = 0.01
    """The same when rendering."""
    drop_unsampled: bool = False
    """Cells that no training ray samples, given its bounds, stay empty for ever."""

    lr: float = 0.002
    """Learning rate."""
    betas: tuple[float, float] = (0.9, 0.98)
    """Of Adam: decay of its two moments."""
    weight_decay: float = 0.2
    """Of AdamW."""
    gradient_clip: float = 1.0
    """Largest norm of all gradients together."""

    half_side: ClassVar[float] = 1.0
    drops_samples: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = ("step_length", "missing_step_length", "dif_period", "lr", "gradient_clip", "mse_weight")
        counts = (
            "first_rays",
            "rays",
            "noise_channels",
            "channels",
            "width",
            "hidden",
            "occupancy_resolution",
            "occupancy_every",
        )
        least_0 = (
            "steps",
            "near",
            "fit_margin",
            "weight_decay",
            "occupancy_density",
        )
        first, second = self.rays_grow_at
        demand(
            self,
            {name: (getattr(self, name) > 0, "a positive number") for name in positive}
            | {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {name: (getattr(self, name) >= 0, "0 or more") for name in least_0}
            | {
                "test_occupancy_density": (
                    0 <= self.test_occupancy_density <= self.occupancy_density,
                    f"0 or more, at most occupancy_density, {self.occupancy_density}",
                ),
                "noise_resolution": (self.noise_resolution >= 2, "2 or more"),
                "rays_grow_at": (0 <= first <= second, "two steps, the second not before the first"),
                "cull_weight": (0 <= self.cull_weight < 1, "a share from 0 to below 1"),
                "view_degree": (0 <= self.view_degree <= 4, "0 to 4"),
                "occupancy_fraction": (0 < self.occupancy_fraction <= 1, "a share above 0, at most 1"),
                "betas": (all(0 <= b < 1 for b in self.betas), "two numbers from 0 to below 1"),
            },
        )
