"""The whole of space drawn into a ball of radius 2 (mip-NeRF 360, eq. 10)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

POINTS_PER_PIECE = 16384
BLOCK = 256


def contract(points: Tensor, std: Tensor | None = None, *, scale: float = 1.0, shift: float = 0.0):
    """Points outside the unit ball come nearer: x -> (2 - 1/|x|) x/|x|; those inside stay.

    A Gaussian's isotropic standard deviation shrinks by the cube root of the Jacobian's determinant, as
    Zip-NeRF has it: outside, lengths change by 1/r^2 along the radius and (2r - 1)/r^2 across.

    Args:
        points: (..., 3), the object about the unit ball.
        std: (...) standard deviations, or None.
        scale, shift: what comes out is multiplied by `scale`, and `shift` is then added to the points.

    Returns:
        (..., 3) points, of norm < 2 before `scale` and `shift`, and with `std` also the new (...) standard
        deviations.
    """
    constant = not (
        torch.is_grad_enabled() and (points.requires_grad or (std is not None and std.requires_grad))
    )
    if std is not None and constant and points.device.type == "cpu" and points.dtype == torch.float32:
        return _contract_cpu(points, std, scale, shift)
    contracted = _contract_torch(points, std)
    if std is None:
        return contracted * scale + shift
    return contracted[0] * scale + shift, contracted[1] * scale


def _contract_torch(points: Tensor, std: Tensor | None):
    r = points.norm(dim=-1).clamp_min(1)
    across = (2 - 1 / r) / r
    contracted = points * across[..., None]
    if std is None:
        return contracted
    return contracted, std * across.square().div(r * r).pow(1 / 3)


def _contract_cpu(points: Tensor, std: Tensor, scale: float, shift: float) -> tuple[Tensor, Tensor]:
    flat = points.detach().reshape(-1, 3).contiguous().numpy()
    deviations = std.detach().float().expand(points.shape[:-1]).reshape(-1).contiguous().numpy()
    out, scaled = np.empty_like(flat), np.empty_like(deviations)
    parallel_for(
        _contract,
        len(flat),
        POINTS_PER_PIECE,
        flat,
        deviations,
        *map(np.float32, (scale, shift)),
        out,
        scaled,
    )
    return torch.from_numpy(out).reshape(points.shape), torch.from_numpy(scaled).reshape(points.shape[:-1])


@kernel(error_model="numpy")
def _contract(begin, end, points, std, scale, shift, out, scaled):
    """In blocks, each step a loop without branches that the compiler can vectorise."""
    one, two, third = np.float32(1), np.float32(2), np.int32(3)
    square = np.empty(BLOCK, np.float32)
    for start in range(begin, end, BLOCK):
        stop = min(start + BLOCK, end)
        p, o, s, to = points[start:stop], out[start:stop], std[start:stop], scaled[start:stop]
        for i in range(stop - start):
            square[i] = max(p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1] + p[i, 2] * p[i, 2], one)
        across = square
        for i in range(stop - start):
            q = one / np.sqrt(square[i])
            across[i] = q * (two - q)
            # The cube root of v: a third of the exponent, then Halley's step twice, 2e-7 relative at the end.
            v = q * across[i]
            root = np.int32(np.float32(v).view(np.int32) // third + np.int32(0x2A514067)).view(np.float32)
            for _ in range(2):
                cube = root * root * root
                root *= (cube + v + v) / (cube + cube + v)
            to[i] = s[i] * root * root * scale
        for i in range(stop - start):
            for axis in range(3):
                o[i, axis] = p[i, axis] * across[i] * scale + shift
