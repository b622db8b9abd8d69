"""Rotations as unit quaternions (w, x, y, z; Hamilton) and 3 x 3 matrices, batched over leading dimensions."""

from __future__ import annotations

import torch
from torch import Tensor


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation matrices of quaternions, normalised first.

    Args:
        quaternion: (..., 4) in the order w, x, y, z; any length but zero.

    Returns:
        (..., 3, 3) rotation matrices.
    """
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)


def quaternion_from_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices.

    Of the four algebraically equal expressions the one with the largest divisor is taken
    (Shepperd 1978), so that no rotation angle loses precision.

    Args:
        matrix: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) unit quaternions.
    """
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    s_w, s_x = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0]
    s_y = m[..., 1, 0] - m[..., 0, 1]
    p_xy, p_xz, p_yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, s_w, s_x, s_y], -1),
            torch.stack([s_w, 1 + m00 - m11 - m22, p_xy, p_xz], -1),
            torch.stack([s_x, p_xy, 1 - m00 + m11 - m22, p_yz], -1),
            torch.stack([s_y, p_xz, p_yz, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    picked = candidates.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    unit = torch.nn.functional.normalize(picked, dim=-1)
    return torch.where(unit[..., :1] < 0, -unit, unit)


def slerp(start: Tensor, end: Tensor, t: Tensor | float) -> Tensor:
    """Rotation matrices on the shortest arc between two rotations.

    Args:
        start, end: (..., 3, 3) rotation matrices.
        t: (...) in [0, 1]; 0 gives start, 1 gives end.

    Returns:
        (..., 3, 3) rotation matrices, start @ exp(t log(start^T end)).
    """
    relative = quaternion_from_matrix(start.mT @ end)  # w >= 0: the short way round
    sine = relative[..., 1:].norm(dim=-1)
    half_angle = torch.atan2(sine, relative[..., 0]) * torch.as_tensor(
        t, dtype=start.dtype, device=start.device
    )
    axis = relative[..., 1:] / sine.clamp_min(torch.finfo(start.dtype).tiny)[..., None]
    part = torch.cat([half_angle.cos()[..., None], half_angle.sin()[..., None] * axis], -1)
    return start @ matrix_from_quaternion(part)
