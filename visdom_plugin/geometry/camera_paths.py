"""Cameras that nobody stood at: between two cameras, looking at a point, on a circle round the object."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras, look_at_point, project
from visdom_plugin.geometry.rotations import slerp


def interpolate(start: Cameras, end: Cameras, t: Tensor | float, look_at: Tensor) -> Cameras:
    """Cameras on the way from one to another that keep a point where it is seen.

    Rotations go along the shortest arc (slerp); the look-at point's camera coordinates go along a line. The
    camera thus swings round that point instead of cutting through it, and is exactly `start` and `end` at 0
    and 1.

    Args:
        start, end: (...) cameras. The result has the size of `start`, and intrinsics interpolated in units of
            the image size.
        t: (...) in [0, 1].
        look_at: (3,) world frame.

    Returns:
        (...) cameras.
    """
    t = torch.as_tensor(t, dtype=start.intrinsics.dtype, device=start.intrinsics.device)
    look_at = look_at.to(start.world_from_camera)
    rotation = slerp(start.world_from_camera[..., :3, :3], end.world_from_camera[..., :3, :3], t)
    homogeneous = torch.cat([look_at, look_at.new_ones(1)])[:, None]
    from_start, from_end = ((c.camera_from_world @ homogeneous)[..., :3, 0] for c in (start, end))
    local = torch.lerp(from_start, from_end, t[..., None])
    centre = look_at - (rotation @ local[..., None])[..., 0]
    motion = torch.cat(
        [torch.cat([rotation, centre[..., None]], -1), start.world_from_camera[..., 3:, :]], -2
    )
    other = end.resized(start.width, start.height)
    intrinsics = torch.lerp(start.intrinsics, other.intrinsics, t[..., None, None])
    return Cameras(intrinsics, motion, start.width, start.height)


def draw_between(cameras: Cameras, look_at: Tensor, generator: Generator | None) -> Cameras:
    """A camera between a random pair of training cameras, uniform in the pair and on the way."""
    first, second = torch.randperm(len(cameras), generator=generator)[:2].tolist()
    t = torch.rand((), generator=generator)
    return interpolate(cameras[first], cameras[second], t, look_at)


def look_at_camera(centre: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """world_from_camera of cameras at `centre` that look at `target`.

    Args:
        centre, target, up: (..., 3) world frame; `up` need not be perpendicular to the view.

    Returns:
        (..., 4, 4) motions, OpenCV axes.
    """
    z = torch.nn.functional.normalize(target - centre, dim=-1)
    x = torch.linalg.cross(z, up.expand_as(z))
    # Looking straight along `up`, any horizontal axis will do.
    spare = torch.eye(3).to(z)[z.abs().argmin(-1)]
    x = torch.where(x.norm(dim=-1, keepdim=True) < 1e-6, torch.linalg.cross(z, spare), x)
    x = torch.nn.functional.normalize(x, dim=-1)
    y = torch.linalg.cross(z, x)
    top = torch.stack([x, y, z, centre.expand_as(z)], -1)
    return torch.cat([top, top.new_tensor([0.0, 0, 0, 1]).expand(*top.shape[:-2], 1, 4)], -2)


_LEVEL = 100.0
"""How much surer it is that cameras are held level than that their mean up is up: (30 / 3 degrees) squared."""


def capture_up(cameras: Cameras) -> Tensor:
    """(3,) unit: which way is up for cameras (N,).

    People hold a camera level, so that its x axis is horizontal, but look down at an object. Their mean up leans
    to the side that most of them stand on, so the direction is taken that is nearly perpendicular to all x axes,
    and no farther from the mean than that needs: the least sum of |up - mean|^2 and, in the mean over
    cameras, `_LEVEL` (x . up)^2. A capture whose cameras' ups cancel (views from above and below) gets z.
    """
    mean_up = -cameras.world_from_camera[:, :3, 1].mean(0)
    if mean_up.norm() <= 0.3:
        return mean_up.new_tensor([0.0, 0.0, 1.0])
    across = cameras.world_from_camera[:, :3, 0]
    normal = _LEVEL * across.T @ across / len(across) + torch.eye(3).to(across)
    return torch.nn.functional.normalize(torch.linalg.solve(normal, mean_up), dim=0)


def orbit(cameras: Cameras, count: int, look_at: Tensor | None = None) -> Cameras:
    """A full circle around the object at the capture's mean distance and height.

    Args:
        cameras: (N,) cameras of the capture; intrinsics and size are those of the first.
        count: number of cameras on the circle.
        look_at: (3,) centre of the circle; by default the capture's look-at point.

    Returns:
        (count,) cameras, starting at the first camera's azimuth.
    """
    target = look_at_point(cameras) if look_at is None else look_at.to(cameras.world_from_camera)
    offsets = cameras.centres - target
    distance = offsets.norm(dim=-1).mean()
    up = capture_up(cameras)
    sine = (torch.nn.functional.normalize(offsets, dim=-1) @ up).mean().clamp(-0.95, 0.95)
    first = offsets[0] - (offsets[0] @ up) * up
    if first.norm() < 1e-6 * distance:
        first = torch.linalg.cross(up, torch.eye(3).to(up)[up.abs().argmin()])
    east = torch.nn.functional.normalize(first, dim=-1)
    north = torch.linalg.cross(up, east)
    angle = torch.arange(count).to(up) * (2 * math.pi / count)
    flat = torch.cos(angle)[:, None] * east + torch.sin(angle)[:, None] * north
    centres = target + distance * ((1 - sine**2).sqrt() * flat + sine * up)
    motion = look_at_camera(centres, target, up)
    one = cameras[0]
    return Cameras(
        one.intrinsics.expand(count, 3, 3), motion, one.width.expand(count), one.height.expand(count)
    )


def widen(cameras: Cameras, points: Tensor, margin: float = 0.05) -> Cameras:
    """Cameras (N,) that look straight ahead, with shorter focal lengths where that is needed to see points (P, 3).

    The principal points come to the middle. All focal lengths are shortened by the same factor.

    Args:
        margin: share of the picture's half that stays free beside the points.
    """
    wider = cameras.intrinsics.clone()
    size = torch.stack([cameras.width, cameras.height], -1)
    wider[:, :2, 2] = size.to(wider) / 2
    middle = Cameras(wider, cameras.world_from_camera, cameras.width, cameras.height)
    uv, depth = project(middle, points.to(cameras.world_from_camera))
    # How far a point lies on its way from the middle to the picture's border.
    share = (uv / size[:, None] * 2 - 1).abs().amax(-1)
    farthest = float(share[depth > 0].amax()) if bool((depth > 0).any()) else 0.0
    factor = min(1.0, (1 - margin) / max(farthest, 1e-9))
    wider[:, 0, 0] *= factor
    wider[:, 1, 1] *= factor
    return middle


def resample(cameras: Cameras, count: int, look_at: Tensor) -> Cameras:
    """Cameras (count,) along the way from the first of (N,) cameras to the last, the same share between any two.

    Args:
        look_at: (3,) point that the way swings round, see `interpolate`.
    """
    legs = max(len(cameras) - 1, 1)
    along = [i * legs / max(count - 1, 1) for i in range(count)]
    starts = [min(int(t), legs - 1) for t in along]
    size = (cameras.width[0], cameras.height[0])
    return Cameras.stack(
        [
            interpolate(cameras[s], cameras[min(s + 1, len(cameras) - 1)], t - s, look_at).resized(*size)
            for s, t in zip(starts, along, strict=True)
        ]
    )


def framed(cameras: Cameras, width: int | None, height: int | None) -> Cameras:
    """Cameras whose pictures have another size, and show as much from top to bottom as before.

    Args:
        width, height: pixels; of one alone the other follows, with both, more or less is seen at the sides.
    """
    if width is None and height is None:
        return cameras
    if width is None or height is None:
        known, other = (cameras.width, cameras.height) if height is None else (cameras.height, cameras.width)
        side = width if height is None else height
        follows = (other * (side or 1) / known).round().clamp_min(1).long()
        given = torch.full_like(follows, side or 1)
        return cameras.resized(*((given, follows) if height is None else (follows, given)))
    ratio = (height / cameras.height.double()).to(cameras.intrinsics)
    K = cameras.intrinsics.clone()
    K[..., :2, :] *= ratio[..., None, None]
    K[..., 0, 2] += (width - cameras.width * ratio) / 2
    return Cameras(
        K,
        cameras.world_from_camera,
        torch.full_like(cameras.width, width),
        torch.full_like(cameras.height, height),
    )
