"""Losses of single rays' colour and opacity, as one operation on the CPU."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.losses import OPAQUE, composite_target, mask_loss

RAYS_PER_PIECE = 512


class Photographed(NamedTuple):
    """What pixels look like in the photographs."""

    rgb: Tensor
    """(n, 3) in [0, 1]."""
    mask: Tensor
    """(n,) 1 on the object."""
    known: Tensor | None
    """(n,) bool, where the mask says something; None for everywhere."""


class RayLosses(NamedTuple):
    """Scalars."""

    colour: Tensor
    """Huber's loss over delta, a mean over the numbers of all colours."""
    mask: Tensor
    """Weighted; see `losses.mask_loss`."""
    psnr: Tensor
    """In dB, at most 100, without gradient."""


def ray_losses(
    rgb: Tensor,
    alpha: Tensor,
    seen: Photographed,
    background: Tensor,
    delta: float,
    mask_weight: float,
    mask_clamp: float = 1e-6,
) -> RayLosses:
    """Compares rays with what photographs show on the same background, see `losses.composite_target`.

    Args:
        rgb: (n, 3) over the background. Differentiable.
        alpha: (n,). Differentiable by the mask's loss.
        background: (n, 3).
        delta: error at which Huber's loss turns from a parabola into a line.
    """
    if all(x.device.type == "cpu" and x.dtype == torch.float32 for x in (rgb, alpha)):
        return RayLosses(*_Compare.apply(rgb, alpha, seen, background, delta, mask_weight, mask_clamp))
    return _ray_losses_torch(rgb, alpha, seen, background, delta, mask_weight, mask_clamp)


def _ray_losses_torch(
    rgb: Tensor,
    alpha: Tensor,
    seen: Photographed,
    background: Tensor,
    delta: float,
    mask_weight: float,
    mask_clamp: float,
) -> RayLosses:
    target = composite_target(seen.rgb, seen.mask, background, alpha=alpha, mask_known=seen.known)
    error = rgb - target
    colour = torch.nn.functional.huber_loss(rgb, target, delta=delta) / delta
    counted = None if seen.known is None else seen.known.float()
    mask = mask_weight * mask_loss(alpha, seen.mask, counted, mask_clamp)
    return RayLosses(colour, mask, -10 * error.detach().square().mean().clamp_min(1e-10).log10())


class _Compare(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rgb: Tensor,
        alpha: Tensor,
        seen: Photographed,
        background: Tensor,
        delta: float,
        mask_weight: float,
        mask_clamp: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        real, n = np.float32, len(alpha)
        tensors = rgb, alpha, seen.rgb, seen.mask, background
        arrays = [x.detach().float().contiguous().numpy() for x in tensors]
        known = np.empty(0, bool) if seen.known is None else seen.known.contiguous().numpy()
        counted = n if seen.known is None else max(int(known.sum()), 1)
        ctx.by_rgb, ctx.by_alpha = np.empty((n, 3), real), np.empty(n, real)
        each = np.empty((3, n))
        shares = real(1 / (3 * n)), real(mask_weight) / real(counted)
        parallel_for(
            _compare, n, RAYS_PER_PIECE, *arrays, known, real(delta), real(mask_clamp),
            *shares, ctx.by_rgb, ctx.by_alpha, each,
        )  # fmt: skip
        colour, mask, squares = each.sum(1)
        psnr = -10 * math.log10(max(squares / (3 * n), 1e-10))
        found = [
            torch.tensor(x, dtype=torch.float32)
            for x in (colour / (3 * n), mask_weight * mask / counted, psnr)
        ]
        ctx.mark_non_differentiable(found[2])
        return found[0], found[1], found[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_colour: Tensor, by_mask: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        by_rgb, by_alpha = (torch.from_numpy(x) for x in (ctx.by_rgb, ctx.by_alpha))
        return by_rgb * by_colour, by_alpha * by_mask, *[None] * 5


@kernel(error_model="numpy")
def _compare(
    begin, end, rgb, alpha, photograph, mask, background, known, delta, clamp,
    colour_share, mask_share, by_rgb, by_alpha, each,
):  # fmt: skip
    """Losses (3, n) of each ray, those of its colour, its mask, and its squared error; and their slopes."""
    real = np.float32
    one, half = real(1), real(0.5)
    soft = clamp > real(1e-6)
    least, most = (clamp if soft else real(1e-6)), (one - clamp if soft else real(OPAQUE))
    for i in range(begin, end):
        counts = len(known) == 0 or known[i]
        a, m = alpha[i], mask[i]
        shown = m if counts else a
        loss, squares = 0.0, 0.0
        for c in range(3):
            error = rgb[i, c] - (photograph[i, c] * shown + background[i, c] * (one - shown))
            size = abs(error)
            squares += error * error
            inner = size < delta
            loss += half * error * error / delta if inner else size - half * delta
            slope = error if inner else (delta if error > 0 else -delta)
            by_rgb[i, c] = colour_share * slope * (one / delta)
        each[0, i], each[2, i] = loss, squares
        bounded = min(max(a, least), most)
        if soft:
            m = min(max(m, least), most)
            inside = bounded == a
        else:
            # Inside the mask nothing is gained beyond the upper bound. The lower one stops an unbounded gradient.
            inside = a >= least and (a <= most or m < one)
        entropy, slope = 0.0, real(0)
        if counts:
            b = np.float64(bounded)
            entropy = -m * math.log(b) - (one - m) * math.log1p(-b)
            slope = (bounded - m) / (bounded * (one - bounded)) * mask_share if inside else real(0)
        each[1, i], by_alpha[i] = entropy, slope
