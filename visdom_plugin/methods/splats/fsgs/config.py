"""Settings of FSGS: plain data, free of heavy imports."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from visdom_plugin.methods.splats.configs import HullStartConfig
from visdom_plugin.validation import demand


@dataclass(frozen=True)
class FsgsConfig(HullStartConfig):
    """FSGS (Zhu et al. 2024): Gaussians grown where they are far apart, and held to monocular depth.

    Defaults are the authors', for captures all round a scene (their command for mip-NeRF 360) where they differ.
    They compare neighbour distances and scales with the scene extent; here both are in extents.
    """

    steps: int = 10_000
    """Optimisation steps, one training view each."""
    sh_every: int = 500
    """Steps between two degrees; training starts at degree 0."""
    lr_means_steps: int = 10_000
    """Steps after which `lr_means_final` is reached."""
    densify_until: int = 10_000
    """Step at which cloning, splitting and pruning ends."""
    densify_gradient: float = 0.0005
    """Mean norm of the loss's gradient by the projected mean, in normalised device units (image = [-1, 1])."""
    opacity_reset_from: int = 2_001
    """First step after which opacities fall to 0.01."""
    opacity_reset_every: int = 3_000
    """Again on every n-th step after that, to the end; 0 never."""

    unpool_until: int = 2_000
    """Before this step densification adds Gaussians halfway between lonely ones and their three nearest
    neighbours; 0 never."""
    unpool_distance: float = 5.0
    """A Gaussian is lonely whose neighbours' root mean squared distance is larger, as a fraction of the extent."""
    unpool_scale: float = 1.0
    """And whose largest standard deviation is larger, as a fraction of the extent."""
    unpool_split_distance: float = 10.0
    """As large as that, and of such a distance, a Gaussian splits as well."""

    depth_weight: float = 0.05
    """Of 1 - Pearson correlation between the rendered depth of the training view and its monocular depth, where
    the scene has depth maps or there is a `depth_network`."""
    depth_weight_late: float = 0.001
    """The same after `depth_until`."""
    depth_until: int = 9_500
    """Last step of `depth_weight`."""
    depth_network: str | None = None
    """`module:function` of your own that takes a picture (H, W, 3) in [0, 1] to its disparity (H, W), in any unit:
    of each photograph once, and of the pseudo views' renders, through which gradients flow."""

    pseudo_views: Literal["ellipse", "between"] = "ellipse"
    """Unseen views whose depth is compared: on an ellipse fitted to the cameras, or between two of them."""
    pseudo_from: int = 2_000
    """First step with a pseudo view. They need a `depth_network`."""
    pseudo_until: int = 9_500
    """Last step with a pseudo view."""
    pseudo_every: int = 10
    """A pseudo view on every n-th step; 0 never."""
    pseudo_weight: float = 0.03
    """Of 1 - Pearson correlation in a pseudo view. The authors have 0.5 by default, 0.03 for mip-NeRF 360."""
    pseudo_ramp: int = 500
    """Steps over which this weight grows from 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = ("opacity_reset_from", "opacity_reset_every", "unpool_until", "depth_until")
        pseudo = ("pseudo_from", "pseudo_until", "pseudo_every", "pseudo_weight", "pseudo_ramp")
        weights = ("depth_weight", "depth_weight_late")
        lengths = ("unpool_distance", "unpool_scale", "unpool_split_distance")
        network = self.depth_network
        demand(
            self,
            {name: (getattr(self, name) >= 0, "0 or more") for name in (*counts, *pseudo, *weights)}
            | {name: (getattr(self, name) > 0, "a positive number") for name in lengths}
            | {
                "depth_network": (
                    network is None or bool(re.fullmatch(r"[\w.]+:[\w.]+", network)),
                    "module:function, such as my_depth:predict, or None",
                )
            },
        )

    def check_requirements(self) -> None:
        """Loads the network, so that a name that leads nowhere is said before the hull is carved."""
        if self.depth_network is not None:
            from visdom_plugin.methods.splats.fsgs.depth import load_network

            load_network(self.depth_network)
