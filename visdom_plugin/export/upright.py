"""Motions that bring a capture's object upright and to the origin, for viewers that know nothing of its frame."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.geometry.camera_paths import capture_up
from visdom_plugin.geometry.cameras import Cameras


def upright(cameras: Cameras, centre: Tensor, up: str) -> Tensor:
    """(4, 4) float64 rigid motion that puts `centre` at the origin, and the capture's up along an axis.

    The first camera looks at the front.

    Args:
        cameras: (N,) cameras of the capture.
        centre: (3,) of the object.
        up: "-y" as viewers of Gaussians take it, "y" as glTF and OBJ have it, "z" as Blender has it.
    """
    cameras, centre = cameras.to("cpu", torch.float64), centre.double()
    above = capture_up(cameras)
    ahead = centre - cameras.centres[0]
    ahead = ahead - (ahead @ above) * above
    if ahead.norm() < 1e-6 * above.norm():
        ahead = torch.linalg.cross(above, torch.eye(3).to(above)[above.abs().argmin()])
    ahead = torch.nn.functional.normalize(ahead, dim=0)
    right = torch.linalg.cross(ahead, above)
    rows = {"-y": [right, -above, ahead], "y": [right, above, -ahead], "z": [right, ahead, above]}[up]
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.stack(rows)
    motion[:3, 3] = -motion[:3, :3] @ centre
    return motion
