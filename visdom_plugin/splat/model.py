"""One trained set of Gaussians: its parameters, its optimiser and its learning rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.splat.densify import initial_log_scales
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.optimiser import GaussianOptimiser
from visdom_plugin.splat.rasterise import NEAR, rasterise
from visdom_plugin.splat.set_config import GaussianSetConfig
from visdom_plugin.splat.spherical_harmonics import sh_from_rgb

INITIAL_OPACITY = 0.1  # 3DGS
RESET_OPACITY = 0.01  # 3DGS


class GaussianSet:
    """Gaussians in training.

    Their parameters are in a unit of the capture's own: float32 rounds alike whatever the unit of the scene.

    Args:
        config: learning rates, harmonics and thresholds.
        xyz: (N, 3) centres to start from, in the cameras' frame.
        rgb: (N, 3) their colours in [0, 1].
        extent: the scene's, see `scene_extent`, scene units.
        unit: of the parameters, in scene units: the cameras' mean distance from what they look at.
    """

    def __init__(
        self,
        config: GaussianSetConfig,
        xyz: Tensor,
        rgb: Tensor,
        *,
        extent: float,
        device: torch.device,
        unit: float = 1.0,
    ):
        self.config, self.extent, self.device, self.unit = config, extent / unit, device, unit
        n, xyz = len(xyz), xyz.double() / unit
        sh = torch.zeros(n, (config.sh_degree + 1) ** 2, 3)
        sh[:, 0] = sh_from_rgb(rgb)
        parameters = {
            "means": xyz,
            "log_scales": initial_log_scales(xyz),
            "quaternions": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
            "opacity_logits": torch.full((n,), INITIAL_OPACITY).logit(),
            "sh": sh,
        }
        self.optimiser = GaussianOptimiser(
            {name: value.float().to(device) for name, value in parameters.items()},
            {
                "means": config.lr_means * self.extent,
                "log_scales": config.lr_scale,
                "quaternions": config.lr_rotation,
                "opacity_logits": config.lr_opacity,
                "sh": config.lr_sh,
            },
        )

    def __len__(self) -> int:
        return len(self.optimiser)

    @property
    def means(self) -> Tensor:
        """(N, 3) centres in the cameras' frame, outside the graph."""
        return self.optimiser.parameters["means"].detach() * self.unit

    def gaussians(self) -> Gaussians:
        """The current Gaussians in the set's own unit, attached to the parameters."""
        return Gaussians(**self.optimiser.parameters)

    def in_scene(self) -> Gaussians:
        """The current Gaussians in the cameras' frame, outside the graph."""
        own = self.gaussians().detach()
        return replace(own, means=own.means * self.unit, log_scales=own.log_scales + math.log(self.unit))

    def draw(
        self,
        camera: Cameras,
        background: Tensor,
        gaussians: Gaussians | None = None,
        sh_degree: int | None = None,
    ) -> Render:
        """See `rasterise`; depth is in scene units.

        Args:
            gaussians: what `gaussians` gave, where several pictures of one step share a graph.
        """
        own = self.gaussians() if gaussians is None else gaussians
        render = rasterise(own, camera.in_units(self.unit), background, near=NEAR, sh_degree=sh_degree)
        return replace(render, depth=render.depth * self.unit)

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and their unit, as a flat dict of tensors."""
        return self.optimiser.state_dict() | {"unit": torch.tensor(self.unit, dtype=torch.float64)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        # Version 0.1.0 had its parameters in scene units.
        ratio = float(state.get("unit", 1.0)) / self.unit
        if ratio != 1:
            factors = {"means": ratio, "adam.means.exp_avg": 1 / ratio, "adam.means.exp_avg_sq": 1 / ratio**2}
            state = {name: value * factors.get(name, 1) for name, value in state.items()}
            state["log_scales"] = state["log_scales"] + math.log(ratio)
        self.optimiser.load_state_dict(state)

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
