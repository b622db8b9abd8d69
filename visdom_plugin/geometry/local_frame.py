"""Frames near their scene, for captures whose own frame has its origin far away, as surveys have.

Float32 tells 16 million places apart. At 5e6 metres from the origin they are half a metre wide, so what computes
in float32 works in a local frame: world = local + origin, with the origin in float64.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras, look_at_point

REACH = 100
"""How many of its own sizes a scene may be away from the origin: float32 then rounds by 6e-6 of the size."""


def is_near(points: ArrayLike | Tensor, size: float) -> bool:
    """Whether points (..., 3) are so near the origin that float32 can hold a scene of that size."""
    return bool(np.abs(np.asarray(points)).max(initial=0) <= REACH * size)


def require_near(points: ArrayLike | Tensor, size: float, where: str) -> None:
    """Refuses a scene that float32 cannot hold.

    Raises:
        ConfigError: when its points (..., 3) are not near the origin, see `is_near`.
    """
    if not is_near(points, size):
        raise ConfigError(
            f"the scene lies more than {REACH} times its size from the frame's origin: float32 moves its points",
            where=where,
            cause="a survey's frame, whose coordinates count from far away",
            todo="train in a frame near the scene: cameras.relative_to(origin) and hull.relative_to(origin), with "
            "origin = visdom_plugin.geometry.local_frame.local_origin(cameras)",
        )


def local_origin(cameras: Cameras) -> Tensor:
    """(3,) float64 origin of a frame near what the cameras look at, on the CPU.

    Zero where that is near the world's origin already, so that nothing changes there. Elsewhere round numbers:
    whole steps of a power of ten, not smaller than the cameras' mean distance from what they look at.

    Args:
        cameras: (N,) cameras; in float64 where the frame is far.
    """
    cameras = cameras.to("cpu", torch.float64)
    middle = cameras.centres.mean(0)
    around = cameras.relative_to(middle)
    centre = look_at_point(around)
    distance = max(float(mean_distance(around, centre)), 1e-12)
    if is_near(middle + centre, distance):
        return torch.zeros(3, dtype=torch.float64)
    step = 10.0 ** math.ceil(math.log10(distance))
    return step * torch.round((middle + centre) / step)


def capture_ball(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Mean (3,) of the camera centres and the largest distance of a camera (N,) from it, a scalar, scene units.

    The frame and the unit of length in which the VisDom authors' release states its numbers.
    """
    centre = cameras.centres.mean(0)
    return centre, (cameras.centres - centre).norm(dim=-1).max()


def mean_distance(cameras: Cameras, target: Tensor | None = None) -> Tensor:
    """Scalar mean distance of the cameras (N,) from a point (3,), by default the one they look at, scene units."""
    target = look_at_point(cameras) if target is None else target
    return (cameras.centres - target).norm(dim=-1).mean()
