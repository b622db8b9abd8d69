"""Losses between a rendered view and what was photographed. Pure functions of one view each."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.ssim import l1_with_ssim


def composite_target(
    image: Tensor,
    mask: Tensor,
    background: Tensor,
    *,
    alpha: Tensor | None = None,
    mask_known: bool | Tensor | None = None,
) -> Tensor:
    """The image that a render on `background` is compared with: photograph inside the mask, background outside.

    Where the mask is unknown the render's own opacity takes its place, as a constant: the target then asks for
    the photograph's colour in whatever is there and leaves open whether anything is, so that the photograph's
    background is painted on nothing and no opacity is called for.

    Args:
        image: (..., 3) in [0, 1].
        mask: (...) float, 1 on the object.
        background: (3,) or (..., 3).
        alpha: (...) rendered opacity; needed where the mask is unknown.
        mask_known: (...) bool, or one for all; None means it is known everywhere.
    """
    if mask_known is not None and mask_known is not True:
        if alpha is None:
            raise ValueError("where a mask is unknown, the target needs the render's alpha")
        known = torch.as_tensor(mask_known, device=mask.device)
        mask = torch.where(known, mask, alpha.detach())
    return image * mask[..., None] + background * (1 - mask[..., None])


def photometric_loss(rgb: Tensor, target: Tensor, ssim_weight: float, weight: Tensor | None = None) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM), as in 3DGS (Kerbl et al. 2023, eq. 7).

    Args:
        rgb, target: (H, W, 3) in [0, 1].
        ssim_weight: w in [0, 1].
        weight: (H, W) float, 0 at pixels that take no part and 1 elsewhere, or None when all do. Both means
            are over the pixels that do; to the windows of SSIM the others look as what is outside the image.
    """
    if weight is not None:
        counted = weight[..., None] > 0
        rgb, target = torch.where(counted, rgb, 0.0), torch.where(counted, target, 0.0)
    if ssim_weight == 0:
        loss = (rgb - target).abs().mean()
    else:
        loss = l1_with_ssim(rgb, target, 1 - ssim_weight, -ssim_weight, ssim_weight)
    return loss if weight is None else loss / weight.mean().clamp_min(1 / weight.numel())


OPAQUE = 1 - 1e-6


def below_one(alpha: Tensor) -> Tensor:
    """Opacity, at most 1 - 1e-6, as losses need it that take log(1 - alpha).

    The bound keeps loss and gradient finite but lets the gradient through: a pixel beyond it is pulled down as
    one at the bound.
    """
    return alpha - (alpha.detach() - OPAQUE).clamp_min(0)


def mask_loss(alpha: Tensor, mask: Tensor, weight: Tensor | None = None, clamp: float = 1e-6) -> Tensor:
    """Mean binary cross entropy between rendered opacity and the foreground mask.

    Args:
        alpha: (H, W) in [0, 1].
        mask: (H, W) float, 1 on the object.
        weight: (H, W) float, 0 at pixels that take no part and 1 elsewhere, or None when all do.
        clamp: distance from 0 and 1, below 0.5, that opacity and mask keep at least. With more than the default,
            an opacity of 1 - `clamp` meets a mask of 1, and one nearer to 0 or 1 than `clamp` has no gradient.
    """
    return _CrossEntropy.apply(alpha, mask, weight, clamp)


class _CrossEntropy(torch.autograd.Function):
    """The mask's loss in fewer operations than autograd makes of it; `below_one` says what happens at 1."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor, weight: Tensor | None, clamp: float) -> Tensor:
        least, most = max(clamp, 1e-6), min(1 - clamp, OPAQUE)
        bounded = alpha.clamp(least, most)
        if clamp > 1e-6:
            mask = mask.clamp(least, most)
            inside = bounded == alpha
        else:
            # Inside the mask nothing is gained beyond the upper bound. The lower one stops an unbounded gradient.
            inside = (alpha >= least) & ((alpha <= most) | (mask < 1))
        count = bounded.numel() if weight is None else weight.sum().clamp_min(1)
        ctx.save_for_backward(bounded, mask, weight, inside)
        ctx.count = count
        total = torch.nn.functional.binary_cross_entropy(bounded, mask, weight, reduction="sum")
        return total / count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        bounded, mask, weight, inside = ctx.saved_tensors
        by_alpha = (bounded - mask) / (bounded * (1 - bounded)) * (slope / ctx.count) * inside
        return by_alpha if weight is None else by_alpha * weight, None, None, None


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
