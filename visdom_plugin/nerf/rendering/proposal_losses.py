"""Losses on step functions: proposals that cover what the NeRF sees, and rays that end in one place.

All return one number per ray; t are sorted edges (..., S + 1), w the weights (..., S) between them. Edges carry
no gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.nerf.sampling import step_kernels
from visdom_plugin.nerf.sampling.step_functions import resample_blurred


def antialiased_interlevel_loss(
    t_nerf: Tensor, w_nerf: Tensor, t_prop: Tensor, w_prop: Tensor, half_width: float, eps: float = 1e-5
) -> Tensor:
    """Zip-NeRF's: the blurred NeRF's mass in each proposal interval, as far as it exceeds the proposal's weight.

    Args:
        t_nerf, w_nerf: (..., S + 1), (..., S); constants, that is, without a gradient.
        t_prop, w_prop: (..., P + 1), (..., P). Differentiable in w_prop.
        half_width: of the blur, in the unit of t. The published values for the two proposals are 0.03 and 0.003.

    Returns:
        (...) sums over the proposal's intervals. The published factor of 0.01 multiplies their mean: divide
        by P.
    """
    if w_prop.device.type == "cpu":
        arrays = t_nerf, w_nerf, t_prop
        return _Sloped.apply(w_prop, step_kernels.interlevel, arrays, half_width, eps)
    return _antialiased_torch(t_nerf, w_nerf, t_prop, w_prop, half_width, eps)


def _antialiased_torch(t_nerf, w_nerf, t_prop, w_prop, half_width, eps):
    target = resample_blurred(t_nerf, w_nerf, half_width, t_prop).to(w_prop)
    return ((target - w_prop).clamp_min(0).square() / (w_prop + eps)).sum(-1)


def distortion_loss(t: Tensor, w: Tensor) -> Tensor:
    """mip-NeRF 360's (eq. 15): the mean distance of two points drawn from the weights, exactly.

    Args:
        t: (..., S + 1) ascending, for instance `ray_warp.curve_distances`. A constant.
        w: (..., S). Differentiable.

    Returns:
        (...) sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (t_{i+1} - t_i), m the intervals' middles.
    """
    if w.device.type == "cpu":
        return _Sloped.apply(w, step_kernels.distortion, (t,))
    return _Distortion.apply(t.detach(), w)


class _Sloped(torch.autograd.Function):
    """A loss of w whose kernel takes other arrays, then w, and finds the slopes along with the loss."""

    @staticmethod
    def forward(ctx, w, kernel, arrays, *scalars):
        (out,) = step_kernels.run(kernel, [w.shape[-1] + 1], (*arrays, w), *scalars)
        ctx.save_for_backward(out[..., :-1])
        return out[..., -1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        (slopes,) = ctx.saved_tensors
        return g[..., None] * slopes, *[None] * (len(ctx.needs_input_grad) - 1)


class _Distortion(torch.autograd.Function):
    """`distortion_loss` on any device, as the kernel finds it."""

    @staticmethod
    def forward(ctx, t, w):
        middles = 0.5 * (t[..., 1:] + t[..., :-1]) - t[..., :1]
        mass, moment = w.cumsum(-1), (w * middles).cumsum(-1)
        distance = middles * (2 * mass - mass[..., -1:]) - (2 * moment - moment[..., -1:])
        distance += w * t.diff(dim=-1) / 3
        ctx.save_for_backward(distance)
        return (w * distance).sum(-1)

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        (distance,) = ctx.saved_tensors
        return None, 2 * g[..., None] * distance
