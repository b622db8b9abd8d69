"""Settings of one trained set of Gaussians: learning rates, harmonics, thresholds. Plain data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from visdom_plugin.validation import demand


@dataclass(frozen=True)
class GaussianSetConfig:
    """How one set of Gaussians is trained. Defaults are those of 3DGS (Kerbl et al. 2023)."""

    steps: int = 30_000
    """Optimisation steps, one training view each."""
    initial_points: int = 20_000
    """Gaussians at the start, drawn from the hull."""
    background: Literal["random", "white"] = "random"
    """Training background behind render and photograph; tests are on white."""
    max_gaussians: int = 3_000_000
    """Densification stops growing beyond this."""

    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 3."""
    sh_every: int = 1_000
    """Steps between two degrees; training starts at degree 0."""

    ssim_weight: float = 0.2
    """Image loss (1 - w) L1 + w (1 - SSIM)."""
    mask_weight: float = 0.0
    """lambda_2, binary cross entropy between rendered opacity and mask."""

    lr_means: float = 1.6e-4
    """Positions, times the scene extent (1.1 x the farthest training camera from their mean)."""
    lr_means_final: float = 1.6e-6
    """Reached, log-linearly, after `lr_means_steps` steps."""
    lr_means_steps: int = 30_000
    """Steps after which `lr_means_final` is reached."""
    lr_sh: float = 0.0025
    """Colour; the higher harmonics learn at a twentieth."""
    lr_opacity: float = 0.05
    """Learning rate of the opacities' logits."""
    lr_scale: float = 0.005
    """Learning rate of the logarithms of the scales."""
    lr_rotation: float = 0.001
    """Learning rate of the quaternions."""

    densify_from: int = 500
    """Step after which Gaussians are cloned, split and pruned."""
    densify_until: int = 15_000
    """Step at which this ends."""
    densify_every: int = 100
    """It happens on every n-th step."""
    densify_gradient: float = 0.0002
    """Mean norm of the loss's gradient by the projected mean, in normalised device units (image = [-1, 1])."""
    densify_scale: float = 0.01
    """Larger Gaussians split, smaller ones are cloned; fraction of the extent."""
    prune_opacity: float = 0.005
    """Densification removes Gaussians below it."""

    def __post_init__(self) -> None:
        counts = ("initial_points", "max_gaussians", "sh_every", "lr_means_steps", "densify_every")
        rates = ("lr_means", "lr_means_final", "lr_sh", "lr_opacity", "lr_scale", "lr_rotation")
        not_negative = ("steps", "mask_weight", "densify_from", "densify_until", "densify_gradient")
        demand(
            self,
            {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {name: (0 < getattr(self, name) < float("inf"), "a positive number") for name in rates}
            | {name: (getattr(self, name) >= 0, "0 or more") for name in not_negative}
            | {
                "sh_degree": (0 <= self.sh_degree <= 3, "0, 1, 2 or 3"),
                "ssim_weight": (0 <= self.ssim_weight <= 1, "a share from 0 to 1"),
                "densify_scale": (self.densify_scale > 0, "a positive number"),
                "prune_opacity": (0 <= self.prune_opacity < 1, "an opacity of at least 0, below 1"),
            },
        )
