"""One trained set of Gaussians: its parameters and optimiser, what densification measures, what it changes.

The schedule is the method's: when to densify, prune or reset is said by whoever holds the set.
"""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from visdom_plugin.render import Render
from visdom_plugin.splat.densify import initial_log_scales, split_children
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
        self._forget_statistics()

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

    def optimise(self, step: int, render: Render) -> None:
        """One Adam step after the backward pass; `render` is the training view's, for densification."""
        c = self.config
        t = min((step + 1) / c.lr_means_steps, 1.0)
        lr = c.lr_means ** (1 - t) * c.lr_means_final**t
        self.optimiser.set_learning_rate("means", lr * self.extent)
        self._collect_statistics(render.info)
        self.optimiser.step()

    def densify(self, draw: Generator, prune_large: tuple[float, float] | None = None) -> None:
        """Clones, splits and prunes by what was measured since the last call.

        Args:
            draw: where the halves of split Gaussians go.
            prune_large: largest radius in pixels and largest scale in extents that may stay, or None for any.
        """
        c, p = self.config, {k: v.detach() for k, v in self.optimiser.parameters.items()}
        grow = self._gradient / self._count.clamp_min(1) >= c.densify_gradient
        if len(self) >= c.max_gaussians:
            grow = torch.zeros_like(grow)
        large = p["log_scales"].exp().amax(-1) > c.densify_scale * self.extent
        clone, split = grow & ~large, grow & large
        children = split_children({k: v[split] for k, v in p.items()}, draw)
        added = {k: torch.cat([v[clone], children[k]]) for k, v in p.items()}
        self.optimiser.append(added)
        new = len(self) - len(split)
        gone = torch.cat([split, split.new_zeros(new)])
        gone |= self.optimiser.parameters["opacity_logits"].sigmoid() < c.prune_opacity
        if prune_large is not None:
            on_screen = torch.cat([self._radius_px, self._radius_px.new_zeros(new)])
            in_space = self.optimiser.parameters["log_scales"].exp().amax(-1)
            gone |= (on_screen > prune_large[0]) | (in_space > prune_large[1] * self.extent)
        if bool(gone.all()):
            gone = torch.zeros_like(gone)
        self.optimiser.keep(~gone)
        self._forget_statistics()

    def remove(self, gone: Tensor | None) -> None:
        """Removes Gaussians where `gone` (N,) bool is True; all of them, or None, and it removes none."""
        if gone is None or not bool(gone.any()) or bool(gone.all()):
            return
        self.optimiser.keep(~gone)
        self._gradient, self._count, self._radius_px = (
            x[~gone] for x in (self._gradient, self._count, self._radius_px)
        )

    def reset_opacity(self) -> None:
        """Lowers all opacities to at most 0.01."""
        ceiling = torch.tensor(RESET_OPACITY).logit()
        logits = self.optimiser.parameters["opacity_logits"]
        self.optimiser.overwrite("opacity_logits", logits.clamp_max(ceiling))

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and measurements as a flat dict of tensors."""
        return self.optimiser.state_dict() | {
            "stats.gradient": self._gradient,
            "stats.count": self._count,
            "stats.radius_px": self._radius_px,
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        self.optimiser.load_state_dict(state)
        self._gradient, self._count, self._radius_px = (
            state[f"stats.{name}"].to(self.device).clone() for name in ("gradient", "count", "radius_px")
        )

    def _forget_statistics(self) -> None:
        zeros = torch.zeros(len(self), device=self.device)
        self._gradient, self._count, self._radius_px = zeros, zeros.clone(), zeros.clone()

    def _collect_statistics(self, info: dict) -> None:
        half_size = torch.tensor([info["width"], info["height"]], device=self.device) / 2
        visible = info["visible"]
        norm = (info["means2d"].grad * half_size).norm(dim=-1)
        self._gradient = self._gradient + torch.where(visible, norm, 0)
        self._count = self._count + visible
        radii = info["radii"] if info["radii"].ndim == 1 else info["radii"].amax(-1)
        self._radius_px = torch.maximum(self._radius_px, torch.where(visible, radii, 0).float())
