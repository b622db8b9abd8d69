"""Six points for each section of a ray's cone, instead of one (Zip-NeRF, section 3 and its supplement).

The points wind along the section as a hexagon twisted into a helix, such that their mean and covariance are
close to those of the conical section.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

ANGLES = tuple(math.pi / 3 * k for k in (0, 2, 4, 3, 5, 1))
STEPS = tuple(3 / math.sqrt(7) * (2 * j / 5 - 1) for j in range(6))


def frame_of(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (..., 3), a right-handed frame with unit directions (..., 3) (Duff et al. 2017)."""
    x, y, z = directions.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    return first, torch.stack([b, sign + y * y * a, -y], -1)


def multisample(
    origins: Tensor,
    directions: Tensor,
    distances: Tensor,
    radius: Tensor,
    random: Tensor | None = None,
    std_scale: float = 0.5,
) -> tuple[Tensor, Tensor]:
    """Hexagonal multisamples of the sections between neighbouring distances.

    Args:
        origins, directions: (..., 3), directions of unit length.
        distances: (..., S + 1) ascending edges along the directions, >= 0.
        radius: (...) or scalar, the cone's radius at distance 1 (mip-NeRF: pixel width times 2/sqrt 12).
        random: (..., S) uniform in [0, 1): turns and mirrors each hexagon at random. None: every other one is
            mirrored and turned by 30 degrees.
        std_scale: the points' standard deviation as a share of their distance from the axis.

    Returns:
        points (..., S, 6, 3) and their isotropic standard deviations (..., S, 6).
    """
    t0, t1 = distances[..., :-1, None], distances[..., 1:, None]
    middle, half = 0.5 * (t0 + t1), 0.5 * (t1 - t0)
    # The published formula divided by the middle's square: no overflow at 1e10 and none of its 0/0 at 0.
    k = half / middle.clamp_min(1e-20)
    steps = k.new_tensor(STEPS)
    inner = (1 + k).square() + 2 + steps * ((k * k - 1).square() + 4).sqrt()
    t = t0 + half * inner / (k * k + 3)
    angles = k.new_tensor(ANGLES)
    if random is None:
        odd = torch.arange(t.shape[-2], device=t.device)[:, None] % 2 == 1
        angles = torch.where(odd, math.pi / 6 - angles, angles)
    else:
        angles = torch.where(random < 0.5, -1.0, 1.0)[..., None] * angles + 4 * math.pi * random[..., None]
    across = t * (torch.as_tensor(radius).to(t)[..., None, None] / math.sqrt(2))
    first, second = frame_of(directions)
    local = torch.stack([across * torch.cos(angles), across * torch.sin(angles), t], -1)
    frame = torch.stack([first, second, directions], -2)
    points = (local.flatten(-3, -2) @ frame).reshape(local.shape) + origins[..., None, None, :]
    return points, std_scale * across
