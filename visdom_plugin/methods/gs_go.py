"""3DGS-GO: Gaussians that start in a hull and are fitted to a few masked photographs.

The coarse stage of GaussianObject (Yang et al. 2024) on 3DGS (Kerbl et al. 2023), without the diffusion
repair. Hooks, where there are any, give the initial points and add their losses.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from visdom_plugin.cameras import Cameras, project
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.losses import composite, disparity_loss, mask_loss, photometric_loss
from visdom_plugin.methods.splat_configs import GsGoConfig
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.seeding import generator
from visdom_plugin.splat.backend_cpu import warm_up
from visdom_plugin.splat.densify import initial_log_scales, split_children, stray_gaussians
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.optimiser import GaussianOptimiser
from visdom_plugin.splat.ply import write_ply
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.splat.spherical_harmonics import sh_from_rgb

log = logging.getLogger(__name__)

INITIAL_OPACITY = 0.1  # 3DGS
RESET_OPACITY = 0.01  # 3DGS


class GsGo:
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def __init__(self, config: GsGoConfig):
        self.config = config
        self.total_steps = config.steps

    def setup(
        self, views: Views, hooks: Sequence[GaussianHook], *, hull, device: torch.device, seed: int
    ) -> None:
        self.device, self.seed, self.hooks = device, seed, list(hooks)
        self.extent = scene_extent(views.cameras)
        if device.type == "cpu":
            log.info("loading the CPU kernels (the first time on a machine they are compiled: 10 to 30 s)")
            warm_up()
        draw = generator(seed, "initial_points")
        if self.hooks:
            xyz, rgb = self.hooks[0].initial_points(self.config.initial_points, draw)
        else:
            xyz = hull.sample_inside(self.config.initial_points, draw).float()
            rgb = mean_masked_colour(xyz, views)
        coefficients = (self.config.sh_degree + 1) ** 2
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
                "means": self.config.lr_means * self.extent,
                "log_scales": self.config.lr_scale,
                "quaternions": self.config.lr_rotation,
                "opacity_logits": self.config.lr_opacity,
                "sh_dc": self.config.lr_sh,
                "sh_rest": self.config.lr_sh / 20,
            },
        )
        self._forget_statistics()

    def train_step(self, batch, step: int) -> dict[str, Tensor]:
        c = self.config
        self.active_degree = min(c.sh_degree, step // c.sh_every)
        gaussians = self.gaussians()
        draw = generator(self.seed, "step", step)
        background = torch.rand(3, generator=draw) if c.background == "random" else torch.ones(3)
        background = background.to(self.device)
        render = self._rasterise(gaussians, batch.camera, background)
        self._render = render
        weight = batch.weight
        target = composite(
            batch.image, batch.mask, background, alpha=render.alpha, mask_known=batch.mask_known
        )
        errors = (render.rgb.detach() - target).square()
        mse = (
            errors.mean() if weight is None else (errors.mean(-1) * weight).sum() / weight.sum().clamp_min(1)
        )
        self.metrics = {"psnr": float(-10 * mse.clamp_min(1e-10).log10())}
        losses = {"photometric": photometric_loss(render.rgb, target, c.ssim_weight, weight)}
        if c.mask_weight and batch.mask_known:
            losses["mask"] = c.mask_weight * mask_loss(render.alpha, batch.mask, weight)
        if c.depth_weight and batch.mono_depth is not None and batch.mask_known:
            object_mask = batch.mask if weight is None else batch.mask * weight
            depth = disparity_loss(render.depth, render.alpha, batch.mono_depth, object_mask)
            if depth is not None:
                losses["depth"] = c.depth_weight * depth
        for i, hook in enumerate(self.hooks):
            losses |= hook.loss(
                lambda camera: self._rasterise(gaussians, camera, background),
                step,
                generator(self.seed, "hook", i, step),
            )
        return losses

    @torch.no_grad()
    def optimise(self, step: int) -> None:
        c = self.config
        t = min((step + 1) / c.lr_means_steps, 1.0)
        lr = c.lr_means ** (1 - t) * c.lr_means_final**t
        self.optimiser.set_learning_rate("means", lr * self.extent)
        self._collect_statistics()
        self.optimiser.step()
        done = step + 1
        if done < c.densify_until:
            if done > c.densify_from and done % c.densify_every == 0:
                self._densify(done)
            if c.floater_every and done % c.floater_every == 0:
                self._remove_strays(done)
            if c.opacity_reset_every and done % c.opacity_reset_every == 0:
                ceiling = torch.tensor(RESET_OPACITY).logit()
                self.optimiser.overwrite(
                    "opacity_logits", self.optimiser.parameters["opacity_logits"].clamp_max(ceiling)
                )
        for hook in self.hooks:
            remove = hook.after_step(self.gaussians(), step)
            if remove is not None and bool(remove.any()) and not bool(remove.all()):
                self._keep(~remove)

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        return self._rasterise(self.gaussians(), camera, background.to(self.device), self.config.sh_degree)

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

    def state_dict(self) -> dict[str, Tensor]:
        return self.optimiser.state_dict() | {
            "stats.gradient": self._gradient,
            "stats.count": self._count,
            "stats.radius_px": self._radius_px,
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.optimiser.load_state_dict(state)
        self._gradient, self._count, self._radius_px = (
            state[f"stats.{name}"].to(self.device).clone() for name in ("gradient", "count", "radius_px")
        )

    def export(self, folder: Path) -> list[Path]:
        path = Path(folder) / "point_cloud.ply"
        write_ply(path, self.gaussians())
        return [path]

    def _rasterise(self, gaussians: Gaussians, camera: Cameras, background: Tensor, degree=None) -> Render:
        degree = self.active_degree if degree is None else degree
        return rasterise(gaussians, camera, background, sh_degree=degree)

    # Densification: what is measured on training views, and what follows from it.

    def _forget_statistics(self) -> None:
        zeros = torch.zeros(len(self.optimiser), device=self.device)
        self._gradient, self._count, self._radius_px = zeros, zeros.clone(), zeros.clone()
        self._render = None

    def _collect_statistics(self) -> None:
        info = self._render.info
        half_size = torch.tensor([info["width"], info["height"]], device=self.device) / 2
        visible = info["visible"]
        norm = (info["means2d"].grad * half_size).norm(dim=-1)
        self._gradient = self._gradient + torch.where(visible, norm, 0)
        self._count = self._count + visible
        radii = info["radii"] if info["radii"].ndim == 1 else info["radii"].amax(-1)
        self._radius_px = torch.maximum(self._radius_px, torch.where(visible, radii, 0).float())
        self._render = None

    def _densify(self, step: int) -> None:
        c, p = self.config, {k: v.detach() for k, v in self.optimiser.parameters.items()}
        grow = self._gradient / self._count.clamp_min(1) >= c.densify_gradient
        if len(self.optimiser) >= c.max_gaussians:
            grow = torch.zeros_like(grow)
        large = p["log_scales"].exp().amax(-1) > c.densify_scale * self.extent
        clone, split = grow & ~large, grow & large
        children = split_children({k: v[split] for k, v in p.items()}, generator(self.seed, "split", step))
        added = {k: torch.cat([v[clone], children[k]]) for k, v in p.items()}
        self.optimiser.append(added)
        new = len(self.optimiser) - len(split)
        gone = torch.cat([split, split.new_zeros(new)])
        gone |= self.optimiser.parameters["opacity_logits"].sigmoid() < c.prune_opacity
        if step > c.prune_large_from:
            on_screen = torch.cat([self._radius_px, self._radius_px.new_zeros(new)])
            in_space = self.optimiser.parameters["log_scales"].exp().amax(-1)
            gone |= (on_screen > c.prune_radius_px) | (in_space > c.prune_scale * self.extent)
        if bool(gone.all()):
            gone = torch.zeros_like(gone)
        self.optimiser.keep(~gone)
        self._forget_statistics()

    def _remove_strays(self, step: int) -> None:
        c = self.config
        if len(self.optimiser) < 16:
            return
        t = (step - c.floater_every) / max(c.densify_until - c.floater_every, 1)
        sigmas = c.floater_sigmas[0] + t * (c.floater_sigmas[1] - c.floater_sigmas[0])
        self._keep(~stray_gaussians(self.optimiser.parameters["means"], sigmas))

    def _keep(self, kept: Tensor) -> None:
        self.optimiser.keep(kept)
        self._gradient, self._count, self._radius_px = (
            x[kept] for x in (self._gradient, self._count, self._radius_px)
        )


def scene_extent(cameras: Cameras) -> float:
    """1.1 x the farthest camera from the cameras' mean, in scene units (3DGS). Training cameras only."""
    centres = cameras.centres
    return float(1.1 * (centres - centres.mean(0)).norm(dim=-1).max())


def mean_masked_colour(points: Tensor, views: Views) -> Tensor:
    """GaussianObject's initial colours: the mean over all views of the black-masked photograph.

    Args:
        points: (N, 3) world frame.

    Returns:
        (N, 3) rgb in [0, 1]; a view that does not see a point counts as black.
    """
    total = torch.zeros(len(points), 3)
    for i in range(len(views)):
        uv, depth = project(views.cameras[i].to(dtype=torch.float32), points.float())
        image = views.images[i].float() / 255 * views.masks[i][..., None]
        height, width = image.shape[:2]
        grid = 2 * uv / uv.new_tensor([width, height]) - 1
        sampled = torch.nn.functional.grid_sample(
            image.permute(2, 0, 1)[None], grid[None, None], align_corners=False
        )[0, :, 0].T
        total += torch.where((depth > 0)[:, None], sampled, 0)
    return total / max(len(views), 1)
