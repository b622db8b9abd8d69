"""Six points for each section of a ray's cone, instead of one (Zip-NeRF, section 3 and its supplement).

The points wind along the section as a hexagon twisted into a helix. Their mean, their variance along the ray and
their summed variance across it are the conical section's; those of a long section reach a little past its end.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

RAYS_PER_PIECE = 32

ANGLES = tuple(math.pi / 3 * k for k in (0, 2, 4, 3, 5, 1))
STEPS = tuple(3 / math.sqrt(7) * (2 * j / 5 - 1) for j in range(6))
UNIT = np.array([[math.cos(a), math.sin(a)] for a in ANGLES], np.float32)


def axes_across(directions: Tensor) -> tuple[Tensor, Tensor]:
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
    radius = torch.as_tensor(radius).to(distances).expand(distances.shape[:-1])
    if distances.device.type == "cpu" and distances.dtype == torch.float32:
        return _multisample_cpu(origins, directions, distances, radius, random, std_scale)
    return _multisample_torch(origins, directions, distances, radius, random, std_scale)


def _multisample_torch(origins, directions, distances, radius, random, std_scale):
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
    across = t * (radius[..., None, None] / math.sqrt(2))
    first, second = axes_across(directions)
    local = torch.stack([across * torch.cos(angles), across * torch.sin(angles), t], -1)
    frame = torch.stack([first, second, directions], -2)
    points = (local.flatten(-3, -2) @ frame).reshape(local.shape) + origins[..., None, None, :]
    return points, std_scale * across


def _multisample_cpu(origins, directions, distances, radius, random, std_scale):
    lead, sections = distances.shape[:-1], distances.shape[-1] - 1
    count = radius.numel()
    rays = tuple(
        x.detach().float().expand(*lead, *shape).reshape(count, *shape).contiguous().numpy()
        for x, shape in ((origins, (3,)), (directions, (3,)), (distances, (sections + 1,)), (radius, ()))
    )
    points = np.empty((count, sections, 6, 3), np.float32)
    std = np.empty((count, sections, 6), np.float32)
    shape = UNIT, np.float32(STEPS), np.float32(std_scale)
    if random is None:
        flat = points.reshape(count, sections, 18)
        parallel_for(_fixed_hexagons, count, RAYS_PER_PIECE, *rays, *shape, flat, std)
    else:
        turns = random.detach().float().expand(*lead, sections).reshape(count, sections).contiguous().numpy()
        parallel_for(_hexagons, count, RAYS_PER_PIECE, *rays, turns, *shape, points, std)
    return torch.from_numpy(points).reshape(*lead, sections, 6, 3), torch.from_numpy(std).reshape(
        *lead, sections, 6
    )


@kernel(error_model="numpy", inline="always")
def _place(t0, t1):
    """Where a section's points lie along its ray: at base + scale * step."""
    real = np.float32
    middle, half = real(0.5) * (t0 + t1), real(0.5) * (t1 - t0)
    k = half / max(middle, real(1e-20))
    squared = (k * k - real(1)) * (k * k - real(1))
    scale = half / (k * k + real(3))
    base = t0 + scale * ((real(1) + k) * (real(1) + k) + real(2))
    return base, scale * math.sqrt(squared + real(4))


@kernel(error_model="numpy", inline="always")
def _axes_across(x, y, z):
    """See `axes_across`."""
    real = np.float32
    sign = real(-1) if z < 0 else real(1)
    a = -real(1) / (sign + z)
    b = x * y * a
    return (real(1) + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@kernel(error_model="numpy", counted=False)
def _hexagons(
    begin, end, origins, directions, distances, radius, random, unit, steps, std_scale, points, std
):
    real = np.float32
    for ray in range(begin, end):
        origin, along = origins[ray], directions[ray]
        first, second = _axes_across(along[0], along[1], along[2])
        wide = radius[ray] * real(math.sqrt(0.5))
        for section in range(distances.shape[1] - 1):
            base, scale = _place(distances[ray, section], distances[ray, section + 1])
            mirrored = random[ray, section] < real(0.5)
            turn = real(4 * math.pi) * random[ray, section]
            cos, sin = math.cos(turn), math.sin(turn)
            point, deviation = points[ray, section], std[ray, section]
            for j in range(6):
                t = base + scale * steps[j]
                across = t * wide
                c, s = unit[j, 0], -unit[j, 1] if mirrored else unit[j, 1]
                x, y = across * (c * cos - s * sin), across * (c * sin + s * cos)
                deviation[j] = std_scale * across
                for axis in range(3):
                    point[j, axis] = x * first[axis] + y * second[axis] + t * along[axis] + origin[axis]


@kernel(error_model="numpy")
def _fixed_hexagons(begin, end, origins, directions, distances, radius, unit, steps, std_scale, points, std):
    """Without random turns: the points of a ray lie on twelve lines, of which every section takes six."""
    real = np.float32
    turn = real(math.pi / 6)
    cos, sin = math.cos(turn), math.sin(turn)
    lines, origin, along = np.empty((2, 18), np.float32), np.empty(18, np.float32), np.empty(18, np.float32)
    for k in range(18):
        along[k] = steps[k // 3]
    for ray in range(begin, end):
        d = directions[ray]
        first, second = _axes_across(d[0], d[1], d[2])
        wide = radius[ray] * real(math.sqrt(0.5))
        for k in range(18):
            j, axis = k // 3, k % 3
            c, s = unit[j, 0], unit[j, 1]
            origin[k] = origins[ray, axis]
            lines[0, k] = wide * (c * first[axis] + s * second[axis]) + d[axis]
            c, s = c * cos + s * sin, c * sin - s * cos
            lines[1, k] = wide * (c * first[axis] + s * second[axis]) + d[axis]
        for section in range(distances.shape[1] - 1):
            base, scale = _place(distances[ray, section], distances[ray, section + 1])
            line = section % 2
            for k in range(18):
                points[ray, section, k] = origin[k] + (base + scale * along[k]) * lines[line, k]
            for j in range(6):
                std[ray, section, j] = std_scale * ((base + scale * steps[j]) * wide)
