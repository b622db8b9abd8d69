"""Losses between a rendered view and what was photographed. Pure functions of one view each."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.ssim import ssim


def photometric_loss(rgb: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), as in 3DGS (Kerbl et al. 2023, eq. 7).

    Args:
        rgb, target: (H, W, 3) in [0, 1].
        ssim_weight: w in [0, 1].
    """
    l1 = (rgb - target).abs().mean()
    return l1 if ssim_weight == 0 else (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(rgb, target))


def mask_loss(alpha: Tensor, mask: Tensor) -> Tensor:
    """Mean binary cross entropy between rendered opacity and the foreground mask.

    Args:
        alpha: (H, W) in [0, 1].
        mask: (H, W) float, 1 on the object.
    """
    return torch.nn.functional.binary_cross_entropy(alpha.clamp(1e-6, 1 - 1e-6), mask)


def disparity_loss(depth: Tensor, alpha: Tensor, mono_depth: Tensor, mask: Tensor) -> Tensor | None:
    """L1 between rendered and monocular disparity after both lose their shift and scale.

    Disparity 1 / depth is shifted by its median and divided by its mean absolute deviation, because
    monocular depth knows neither (Ranftl et al. 2020; GaussianObject's coarse stage).

    Args:
        depth, alpha: (H, W) rendered; depth in scene units.
        mono_depth: (H, W) in any unit, <= 0 where unknown.
        mask: (H, W) float, 1 on the object.

    Returns:
        Scalar, or None when fewer than ten pixels have all three.
    """
    valid = (mask > 0.5) & (alpha > 0.5) & (depth > 0) & (mono_depth > 0)
    if int(valid.sum()) < 10:
        return None

    def normalised(disparity: Tensor) -> Tensor:
        shifted = disparity - disparity.median()
        return shifted / shifted.abs().mean().clamp_min(1e-8)

    return (normalised(1 / depth[valid]) - normalised(1 / mono_depth[valid])).abs().mean()
