"""One trained set of Gaussians: its parameters, its optimiser and its learning rates."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.splat.densify import initial_log_scales
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.optimiser import GaussianOptimiser
from visdom_plugin.splat.set_config import GaussianSetConfig
from visdom_plugin.splat.spherical_harmonics import sh_from_rgb

INITIAL_OPACITY = 0.1  # 3DGS
RESET_OPACITY = 0.01  # 3DGS


class GaussianSet:
    """Gaussians in training.

    Args:
        config: learning rates, harmonics and thresholds.
        xyz: (N, 3) centres to start from, world frame.
        rgb: (N, 3) their colours in [0, 1].
        extent: the scene's, see `scene_extent`.
    """

    def __init__(
        self, config: GaussianSetConfig, xyz: Tensor, rgb: Tensor, *, extent: float, device: torch.device
    ):
        self.config, self.extent, self.device = config, extent, device
        coefficients = (config.sh_degree + 1) ** 2
        n = len(xyz)
        parameters = {
            "means": xyz,
            "log_scales": initial_log_scales(xyz),
            "quaternions": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
            "opacity_logits": torch.full((n,), INITIAL_OPACITY).logit(),
            "sh_dc": sh_from_rgb(rgb)[:, None, :],
            "sh_rest": torch.zeros(n, coefficients - 1, 3),
        }
        self.optimiser = GaussianOptimiser(
            {name: value.float().to(device) for name, value in parameters.items()},
            {
                "means": config.lr_means * extent,
                "log_scales": config.lr_scale,
                "quaternions": config.lr_rotation,
                "opacity_logits": config.lr_opacity,
                "sh_dc": config.lr_sh,
                "sh_rest": config.lr_sh / 20,
            },
        )

    def __len__(self) -> int:
        return len(self.optimiser)

    @property
    def means(self) -> Tensor:
        """(N, 3) centres, world frame, outside the graph."""
        return self.optimiser.parameters["means"].detach()

    def gaussians(self) -> Gaussians:
        """The current Gaussians, attached to the parameters."""
        p = self.optimiser.parameters
        return Gaussians(
            means=p["means"],
            log_scales=p["log_scales"],
            quaternions=p["quaternions"],
            opacity_logits=p["opacity_logits"],
            sh=torch.cat([p["sh_dc"], p["sh_rest"]], 1),
        )

    def optimise(self, step: int) -> None:
        """One Adam step, at the step's learning rates; gradients are dropped afterwards."""
        c = self.config
        t = min((step + 1) / c.lr_means_steps, 1.0)
        lr = c.lr_means ** (1 - t) * c.lr_means_final**t
        self.optimiser.set_learning_rate("means", lr * self.extent)
        self.optimiser.step()

    def reset_opacity(self) -> None:
        """Lowers all opacities to at most 0.01."""
        ceiling = float(torch.tensor(RESET_OPACITY).logit())
        logits = self.optimiser.parameters["opacity_logits"]
        self.optimiser.overwrite("opacity_logits", logits.clamp_max(ceiling))
