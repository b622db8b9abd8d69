"""What the splatting methods share: the losses of a training view, backgrounds, the scene's extent."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Generator, Tensor

from visdom_plugin.compute.transfer import send
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.losses import composite_target, mask_loss, photometric_loss
from visdom_plugin.methods.colour_correction import ColourCorrection
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.set_config import GaussianSetConfig
from visdom_plugin.training.protocols import ViewBatch

_TRANSPARENT = -20.0
"""Opacity logit of a Gaussian that is left out: nothing of it is drawn, and it has no gradient."""


def fit_view(
    render: Render,
    batch: ViewBatch,
    background: Tensor,
    config: GaussianSetConfig,
    correction: ColourCorrection | None = None,
) -> tuple[dict[str, Tensor], Tensor]:
    """How far the render of a training view is from its photograph on the same background.

    Args:
        correction: of the views' colours, where there is one.

    Returns:
        Weighted losses by name, and the PSNR in dB, a scalar without gradient.
    """
    weight = batch.weight
    target = composite_target(
        batch.image, batch.mask, background, alpha=render.alpha, mask_known=batch.mask_known
    )
    rgb = render.rgb
    if correction is not None:
        rgb = correction.apply(rgb, render.alpha, background, batch.index)
    errors = (rgb.detach() - target).square()
    mse = errors.mean() if weight is None else (errors.mean(-1) * weight).sum() / weight.sum().clamp_min(1)
    losses = {"photometric": photometric_loss(rgb, target, config.ssim_weight, weight)}
    if config.mask_weight and batch.mask_known:
        losses["mask"] = config.mask_weight * mask_loss(render.alpha, batch.mask, weight)
    return losses, -10 * mse.clamp_min(1e-10).log10()


def drop_some(gaussians: Gaussians, rate: float, generator: Generator) -> Gaussians:
    """Gaussians of which a random share is transparent and the rest 1 / (1 - rate) times as opaque, at most 0.995.

    Args:
        rate: the share, in [0, 1); at 0 they stay as they are.
    """
    if not rate:
        return gaussians
    logits = gaussians.opacity_logits
    kept = torch.rand(len(gaussians), generator=generator).to(logits.device) >= rate
    opacity = (logits.sigmoid() / (1 - rate)).clamp(1e-6, 0.995)
    return replace(gaussians, opacity_logits=torch.where(kept, opacity.logit(), _TRANSPARENT))


def draw_background(config: GaussianSetConfig, generator: Generator, device: torch.device) -> Tensor:
    """(3,) the training background of a step."""
    if config.background != "random":
        return torch.ones(3, device=device)
    return send(torch.rand(3, generator=generator), device)


def scene_extent(cameras: Cameras) -> float:
    """1.1 x the farthest camera from the cameras' mean, in scene units (3DGS). Training cameras only."""
    centres = cameras.centres
    return float(1.1 * (centres - centres.mean(0)).norm(dim=-1).max())
