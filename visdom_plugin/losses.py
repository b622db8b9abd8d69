"""Losses between a rendered view and what was photographed. Pure functions of one view each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lane_math import log2
from visdom_plugin.compute.lanes import WIDTH, count_up, fill, load, maximum, minimum, store, totals, where
from visdom_plugin.compute.parallel import parallel_for
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
        least, most, soft = max(clamp, 1e-6), min(1 - clamp, OPAQUE), clamp > 1e-6
        ctx.count = alpha.numel() if weight is None else weight.sum().clamp_min(1)
        same = mask.shape == alpha.shape and mask.dtype == alpha.dtype
        if not same or not fills_vectors(alpha):
            total, slopes = cross_entropy_by_torch(alpha, mask, weight, least, most, soft)
        else:
            arrays = flat(alpha, mask, alpha[:0] if weight is None else weight.to(alpha))
            by_alpha, sums = np.empty_like(arrays[0]), np.empty(-(-alpha.numel() // BLOCK))
            bounds = [arrays[0].dtype.type(x) for x in (least, most)]
            parallel_for(_cross_entropy, len(sums), BLOCKS_PER_PIECE, *arrays, *bounds, soft, sums, by_alpha)
            total, slopes = alpha.new_tensor(sums.sum()), torch.from_numpy(by_alpha).view(alpha.shape)
        ctx.save_for_backward(slopes)
        return total / ctx.count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return slopes * (slope / ctx.count), None, None, None


def cross_entropy_by_torch(
    alpha: Tensor, mask: Tensor, weight: Tensor | None, least: float, most: float, soft: bool
) -> tuple[Tensor, Tensor]:
    """Sum of the cross entropies, and its derivatives by alpha, on any device.

    Args:
        least, most: bounds of the opacity; of the mask too, where it is `soft`.
    """
    bounded = alpha.clamp(least, most)
    if soft:
        mask = mask.clamp(least, most)
        inside = bounded == alpha
    else:
        # Inside the mask nothing is gained beyond the upper bound. The lower one stops an unbounded gradient.
        inside = (alpha >= least) & ((alpha <= most) | (mask < 1))
    total = torch.nn.functional.binary_cross_entropy(bounded, mask, weight, reduction="sum")
    slopes = (bounded - mask) / (bounded * (1 - bounded)) * inside
    return total, slopes if weight is None else slopes * weight


BLOCK, BLOCKS_PER_PIECE = 1024, 4
"""Pixels that are summed up together, and how many times that is worth a thread."""


def fills_vectors(alpha: Tensor) -> bool:
    """Whether kernels take it."""
    return (
        alpha.device.type == "cpu"
        and alpha.dtype in (torch.float32, torch.float64)
        and alpha.numel() >= WIDTH
    )


def flat(*tensors: Tensor) -> list[np.ndarray]:
    return [np.ascontiguousarray(x.detach().numpy()).reshape(-1) for x in tensors]


@kernel(error_model="numpy")
def _cross_entropy(begin, end, alpha, mask, weight, least, most, soft, sums, slopes):
    """Blocks begin .. end - 1 of `cross_entropy_by_torch`; an empty weight is none.

    The last vector ends where the array ends: it repeats part of the one before.
    """
    zero, one = alpha.dtype.type(0), alpha.dtype.type(1)
    endless = fill(alpha.dtype.type(np.inf))
    row = np.empty(WIDTH, alpha.dtype)
    for block in range(begin, end):
        total = fill(zero)
        for j0 in range(block * BLOCK, min((block + 1) * BLOCK, len(alpha)), WIDTH):
            j = min(j0, len(alpha) - WIDTH)
            a, m = load(alpha, j), load(mask, j)
            p = minimum(maximum(a, least), most)
            top = where(m < one, endless, most)
            if soft:
                m, top = minimum(maximum(m, least), most), fill(most)
            value = (m * log2(p) + (one - m) * log2(one - p)) * alpha.dtype.type(-math.log(2))
            slope = where((a >= least) & (a <= top), (p - m) / (p * (one - p)), zero)
            if weight.size:
                value, slope = value * load(weight, j), slope * load(weight, j)
            # NaN stays NaN.
            total = total + where(count_up(zero) >= alpha.dtype.type(j0 - j), value + (a - a), zero)
            store(slopes, j, slope)
        store(row, 0, totals((total,)))
        sums[block] = row[0]


def outside_sum(alpha: Tensor, hull_mask: Tensor) -> tuple[Tensor, Tensor]:
    """Of opacity and the hull's silhouette, of one shape: the sum of -log(1 - alpha) beside it, and 1 - alpha
    there, infinite elsewhere.

    Opacity counts as 1 - 1e-6 at most.
    """
    if not fills_vectors(alpha):
        bounded = alpha.clamp_max(OPAQUE)
        return -bounded.neg().log1p_().masked_fill_(hull_mask, 0).sum(), (1 - bounded).masked_fill_(
            hull_mask, torch.inf
        )
    arrays = flat(alpha, hull_mask)
    room, sums = np.empty_like(arrays[0]), np.empty(-(-alpha.numel() // BLOCK))
    most = arrays[0].dtype.type(OPAQUE)
    parallel_for(_outside, len(sums), BLOCKS_PER_PIECE, *arrays, most, sums, room)
    return alpha.new_tensor(sums.sum()), torch.from_numpy(room).view(alpha.shape)


@kernel(error_model="numpy")
def _outside(begin, end, alpha, hull_mask, most, sums, room):
    """Blocks begin .. end - 1 of `outside_sum`."""
    real = alpha.dtype.type
    zero, one, endless = real(0), real(1), real(np.inf)
    row = np.empty(WIDTH, alpha.dtype)
    for block in range(begin, end):
        first, last = block * BLOCK, min((block + 1) * BLOCK, len(alpha))
        for i in range(first, last):
            left = one - (most if alpha[i] > most else alpha[i])
            room[i] = endless if hull_mask[i] else left
        total = fill(zero)
        for j0 in range(first, last, WIDTH):
            j = min(j0, len(alpha) - WIDTH)
            a, left = load(alpha, j), load(room, j)
            a = where(a > most, most, a)
            # log(1 - a), made good for what the difference was rounded by (Kahan).
            value = where(
                (left <= one) & (left >= one), a, log2(left) * real(math.log(2)) * (a / (left - one))
            )
            value = where(left >= endless, zero, value)
            total = total + where(count_up(zero) >= real(j0 - j), value, zero)
        store(row, 0, totals((total,)))
        sums[block] = row[0]


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
