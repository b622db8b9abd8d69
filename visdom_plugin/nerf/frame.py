"""The frame in which radiance fields live: the cameras' look-at point at the origin, cameras at distance 1."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.geometry.local_frame import mean_distance


class Frame(NamedTuple):
    """local = (world - centre) * scale. Directions are the same in both."""

    centre: Tensor
    """(3,) float64 world frame."""
    scale: float
    """1 / mean distance of the training cameras from the centre."""

    def to_local(self, points: Tensor) -> Tensor:
        """(..., 3) world to local; differences are taken before any rounding to float32."""
        return ((points.double() - self.centre.to(points.device)) * self.scale).float()

    def to_world(self, points: Tensor) -> Tensor:
        """(..., 3) local to world, float64."""
        return points.double() / self.scale + self.centre.to(points.device)


def frame_of(cameras: Cameras) -> Frame:
    """The frame of a capture, from its training cameras alone.

    Args:
        cameras: (N,) cameras.
    """
    cameras = cameras.to("cpu", torch.float64)
    centre = look_at_point(cameras)
    return Frame(centre, float(1 / mean_distance(cameras, centre).clamp_min(1e-12)))
