"""Settings of SplatFields: plain data, free of heavy imports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from visdom_plugin.methods.splats.configs import HullStartConfig
from visdom_plugin.validation import demand


@dataclass(frozen=True)
class SplatFieldsConfig(HullStartConfig):
    """SplatFields (Mihajlovic et al. 2024): a neural field says what each Gaussian looks like.

    Defaults are the authors' for synthetic objects. Their first stage, 3DGS of the same length whose points are
    taken over, is left out: Gaussians start in the hull, which is where that stage starts.
    """

    steps: int = 40_000
    """Optimisation steps, one training view each."""
    initial_points: int = 100_000
    """Gaussians at the start, drawn from the hull."""
    background: Literal["random", "white"] = "white"
    """Training background behind render and photograph; tests are on white."""
    sh_degree: int = 0
    """The field's colours look alike from all sides."""
    densify_until: int = 40_000
    """Step at which cloning, splitting and pruning ends."""

    noise_channels: int = 8
    """Channels of the frozen noise that planes are made of."""
    noise_size: int = 20
    """Pixels along a side of the frozen noise; the three planes made of it have sixteen times as many."""
    plane_channels: int = 16
    """Features of each plane."""
    decoder_width: int = 32
    """Channels inside the network that makes a plane."""
    mlp_depth: int = 4
    """Hidden layers between the planes' features and the Gaussian's attributes."""
    mlp_width: int = 128
    """Width of these layers."""
    lr_field: float = 8e-4
    """Of the networks: 5 x 1.6e-4."""
    lr_field_final: float = 1.6e-6
    """Reached, log-linearly, after `lr_field_steps` steps."""
    lr_field_steps: int = 40_000
    """Steps after which `lr_field_final` is reached."""

    mask_l1_weight: float = 0.1
    """Mean absolute difference between rendered opacity and mask."""
    norm_weight: float = 0.04
    """Mean distance of the Gaussians from what the cameras look at, in mean distances of the cameras from it. The
    authors' 0.01 is for units of which the cameras are 4 away."""
    moran_weight: float = 0.0
    """How little scales, rotations, opacities and colours resemble those of their neighbours (1 - Moran's I). The
    authors use 0.01 with 3DGS."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = (
            "noise_channels",
            "noise_size",
            "plane_channels",
            "decoder_width",
            "mlp_depth",
            "mlp_width",
            "lr_field_steps",
        )
        weights = ("mask_l1_weight", "norm_weight", "moran_weight")
        rates = ("lr_field", "lr_field_final")
        demand(
            self,
            {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {name: (getattr(self, name) >= 0, "0 or more") for name in weights}
            | {name: (0 < getattr(self, name) < float("inf"), "a positive number") for name in rates},
        )
