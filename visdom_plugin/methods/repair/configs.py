"""Settings of GaussianObject: plain data, free of heavy imports. Defaults are the published schedule."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from visdom_plugin.methods.repair import weights
from visdom_plugin.methods.repair.weights import WeightsConfig
from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.validation import demand

Range = tuple[float, float]
"""Lowest and highest of a number that is drawn anew each time."""


@dataclass(frozen=True)
class LeaveOneOutConfig:
    """Runs of the coarse stage that lack one view each, for pairs of a corrupted render and its
    photograph."""

    steps: int = 10_000
    """Of each run."""
    view_returns: int = 6_000
    """From this step on the run sees all views, and a twin goes on without the view; Gaussians are neither
    added nor removed."""
    kept_steps: int = 100
    """Renders of the view are kept from so many steps after its return, one for each pass over the views."""

    def __post_init__(self) -> None:
        demand(
            self,
            {
                "steps": (self.steps >= 2, "2 or more"),
                "view_returns": (0 < self.view_returns < self.steps, "a step of the run, 1 or later"),
                "kept_steps": (self.kept_steps >= 1, "1 or more"),
            },
            within="loo",
        )


@dataclass(frozen=True)
class LoraConfig:
    """Fine-tuning of UNet, ControlNet and text encoder on the pairs, by low-rank updates of their weights."""

    steps: int = 1_800
    """One pair each."""
    rank: int = 64
    """Of the updates, in the transformer blocks of UNet and ControlNet."""
    alpha: float = 1.0
    """They are scaled by alpha / rank."""
    text_encoder: bool = True
    """Update the text encoder, too."""
    lr: float = 1e-3
    """Of AdamW."""
    token: str = "xxy5syt00"
    """Word for the object, in "a photo of a ..."."""
    noise_steps: int = 100
    """Until here every render is of the coarse Gaussians with noise."""
    noise_decay: float = 0.995
    """From there the share of such renders falls by this factor each step; the others are those kept when a
    view was left out."""
    noise_scale: Range = (0.6, 0.8)
    """Where noise on scales, rotations and opacities is cut, in its standard deviations."""
    noise_dropout: Range = (0.6, 0.8)
    """Share of the numbers that stay as they are."""

    def __post_init__(self) -> None:
        demand(
            self,
            {
                "steps": (self.steps >= 1, "1 or more"),
                "rank": (self.rank >= 1, "1 or more"),
                "alpha": (0 < self.alpha < float("inf"), "a positive number"),
                "lr": (0 < self.lr < float("inf"), "a positive number"),
                "token": (bool(self.token.strip()), "a word"),
                "noise_steps": (self.noise_steps >= 0, "0 or more"),
                "noise_decay": (0 <= self.noise_decay <= 1, "a factor from 0 to 1"),
                "noise_scale": (
                    0 <= self.noise_scale[0] <= self.noise_scale[1],
                    "two numbers that ascend from 0",
                ),
                "noise_dropout": (
                    0 <= self.noise_dropout[0] <= self.noise_dropout[1] <= 1,
                    "two shares from 0 to 1 that ascend",
                ),
            },
            within="lora",
        )


@dataclass(frozen=True)
class RepairConfig:
    """Views that nobody photographed, drawn by the coarse Gaussians and repaired by the networks, as
    targets."""

    steps: int = 4_000
    """Of the last stage, which starts from the coarse Gaussians."""
    until: int = 2_800
    """Last step with a repaired view."""
    share: Range = (1.0, 0.5)
    """r, from the first step to that one: the loss is (1 - r) times the coarse stage's on a training view
    and r times that on a repaired view."""
    poses: int = 8
    """Views that are repaired together."""
    refresh_every: int = 200
    """Steps until others are."""
    novel_views: Literal["ellipse", "between"] = "ellipse"
    """Where they stand: on an ellipse fitted to the training cameras, or between two of them. The original
    fits it to all cameras of the scene, those of the test views as well."""
    away: float = 0.8
    """How far from the middle between two neighbours they may stand: 0 for there alone, 1 from a quarter to
    three quarters of the way."""
    ddim_steps: int = 50
    """Steps of DDIM in which a view is repaired."""
    strength: Range = (0.1, 1.0)
    """How far towards pure noise a render is taken before it is denoised, drawn for each."""
    guidance: float = 1.0
    """Of the text; 1 asks the networks once a step, anything else twice."""
    eta: float = 1.0
    """Noise of each DDIM step: 0 for none, 1 for that of DDPM."""
    score: Literal["paper", "released"] = "paper"
    """Weight of a repaired view, 1 - alpha_bar of the noise it started from. The authors' code looks the
    DDIM step up in the table of the 1,000 training steps, which gives at most 0.05."""
    l1_weight: float = 0.5
    """Of the mean absolute difference to a repaired view."""
    l2_weight: float = 0.5
    """Of the mean squared difference to a repaired view."""
    lpips_weight: float = 2.0
    """Off where the package lpips or its VGG weights are not there; the run says so."""
    domain: bool = False
    """Whether the hooks of the visible domain take part in this stage, too: L_i, and Gaussians outside the
    hull are removed. The VisDom authors' release has them in the coarse stage only."""

    lr_means: float = 1.6e-6
    """Learning rate of the positions in this stage, times the scene extent."""
    densify_gradient: float = 3e-6
    """Threshold of densification in this stage, as `densify_gradient` of the coarse one."""
    densify_from: int = 400
    """Step after which Gaussians are cloned, split and pruned in this stage."""
    densify_until: int = 3_600
    """Step at which this ends."""
    densify_every: int = 100
    """It happens on every n-th step."""
    prune_opacity: float = 0.02
    """Densification removes Gaussians below it."""
    prune_large_from: int = 300
    """From this step on Gaussians that are too large are removed."""
    opacity_reset_every: int = 500
    """Opacities fall to 0.01 on every n-th step of this stage; 0 never."""
    fewest_gaussians: int = 10_000
    """Of so many or fewer none is removed for being faint or large."""

    def __post_init__(self) -> None:
        counts = ("steps", "poses", "refresh_every", "ddim_steps", "densify_every")
        weights = ("l1_weight", "l2_weight", "lpips_weight", "guidance", "eta")
        demand(
            self,
            {name: (getattr(self, name) >= 1, "1 or more") for name in counts}
            | {name: (getattr(self, name) >= 0, "0 or more") for name in weights}
            | {
                "until": (0 <= self.until <= self.steps, "a number of steps, at most those of the stage"),
                "share": (0 <= min(self.share) <= max(self.share) <= 1, "two shares from 0 to 1"),
                "away": (0 <= self.away <= 1, "a share from 0 to 1"),
                "strength": (0 < self.strength[0] <= self.strength[1] <= 1, "two shares above 0 that ascend"),
                "lr_means": (0 < self.lr_means < float("inf"), "a positive number"),
            },
            within="repair",
        )


@dataclass(frozen=True)
class GaussianObjectConfig(GsGoConfig):
    """GaussianObject (Yang et al. 2024): the coarse stage, whose settings these are, and its diffusion
    repair."""

    weights: WeightsConfig = field(default_factory=WeightsConfig)
    """The networks' folders."""
    image_size: int = 512
    """Pixels of the square that the networks see, cut from the middle of a picture or padded with white;
    512 is what Stable Diffusion 1.5 was trained for."""
    loo: LeaveOneOutConfig = field(default_factory=LeaveOneOutConfig)
    """Stage 2."""
    lora: LoraConfig = field(default_factory=LoraConfig)
    """Stage 3."""
    repair: RepairConfig = field(default_factory=RepairConfig)
    """Stage 4."""

    def __post_init__(self) -> None:
        super().__post_init__()
        demand(
            self,
            {"steps": (self.steps >= 1, "1 or more"), "image_size": (self.image_size >= 8, "8 or more")},
        )

    def check_requirements(self) -> None:
        """See `weights.check`."""
        weights.check(self.weights, self.image_size)
