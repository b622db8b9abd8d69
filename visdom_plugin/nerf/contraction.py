"""The whole of space drawn into a ball of radius 2 (mip-NeRF 360, eq. 10)."""

from __future__ import annotations

from torch import Tensor


def contract(points: Tensor, std: Tensor | None = None):
    """Points outside the unit ball come nearer: x -> (2 - 1/|x|) x/|x|; those inside stay.

    A Gaussian's isotropic standard deviation shrinks by the cube root of the Jacobian's determinant, as
    Zip-NeRF has it: outside, lengths change by 1/r^2 along the radius and (2r - 1)/r^2 across.

    Args:
        points: (..., 3), the object about the unit ball.
        std: (...) standard deviations, or None.

    Returns:
        (..., 3) points of norm < 2, and with `std` also the new (...) standard deviations.
    """
    r = points.norm(dim=-1).clamp_min(1)
    across = (2 - 1 / r) / r
    contracted = points * across[..., None]
    if std is None:
        return contracted
    return contracted, std * across.square().div(r * r).pow(1 / 3)


def uncontract(points: Tensor) -> Tensor:
    """The inverse of `contract`: (..., 3) points of norm < 2 to (..., 3) points of any norm."""
    norm = points.norm(dim=-1, keepdim=True).clamp_min(1)
    return points / (norm * (2 - norm))
