"""The frame nerfstudio trains in, and the way back to the world: plain arithmetic, without nerfstudio.

Nerfstudio's data parsers move a capture to the origin and scale it, and hand the motion on as
`dataparser_transform` and `dataparser_scale`: model = scale * (transform applied to world). Its cameras use
OpenGL's axes (y up, z backward).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras, look_at_point


class Similarity(NamedTuple):
    """model = scale * (R world + t), nerfstudio's convention. Lengths along rays grow by `scale`."""

    transform: Tensor
    """(3, 4) float64 [R | t]; R is a rotation."""
    scale: float
    """> 0, model units per world unit."""

    def points_to_model(self, world: Tensor) -> Tensor:
        """(..., 3) world to model, computed in float64, in the points' dtype and on their device."""
        rotation, shift = self._parts(world)
        return ((world.double() @ rotation.mT + shift) * self.scale).to(world)

    def points_to_world(self, model: Tensor) -> Tensor:
        """(..., 3) model to world, float64: a world frame far from its origin outgrows float32."""
        rotation, shift = self._parts(model)
        return (model.double() / self.scale - shift) @ rotation

    def directions_to_world(self, model: Tensor) -> Tensor:
        """(..., 3) turned, their length kept; float64. t along them is in world units: t_model / scale."""
        return model.double() @ self._parts(model)[0]

    def directions_to_model(self, world: Tensor) -> Tensor:
        """(..., 3) turned, their length kept, in the directions' dtype and on their device."""
        return (world.double() @ self._parts(world)[0].mT).to(world)

    def poses_to_model(self, cameras: Cameras) -> Tensor:
        """(..., 3, 4) camera-to-model matrices in OpenGL's axes, float64."""
        motion = cameras.world_from_camera.double()
        rotation, shift = self._parts(motion)
        turned = rotation @ motion[..., :3, :3] * motion.new_tensor([1.0, -1.0, -1.0])
        centre = (motion[..., :3, 3] @ rotation.mT + shift) * self.scale
        return torch.cat([turned, centre[..., None]], -1)

    def _parts(self, like: Tensor) -> tuple[Tensor, Tensor]:
        transform = self.transform.to(like.device, torch.float64)
        return transform[:, :3], transform[:, 3]


def similarity_of(cameras: Cameras) -> Similarity:
    """The frame of a capture: look-at point at the origin, cameras at mean distance 1, their mean up is +z.

    Nerfstudio's contraction leaves [-1, 1]^3 as it is, so that the object lies in the uncontracted part.

    Args:
        cameras: (N,) training cameras, and no others: test poses must not move the frame.
    """
    cameras = cameras.to("cpu", torch.float64)
    centre = look_at_point(cameras)
    scale = 1 / float((cameras.centres - centre).norm(dim=-1).mean().clamp_min(1e-12))
    up = -cameras.world_from_camera[:, :3, 1].mean(0)
    # Without a common up (views from above and below) the world's own axes are as good as any.
    rotation = _turn_up(up / up.norm()) if up.norm() > 0.3 else torch.eye(3, dtype=torch.float64)
    return Similarity(torch.cat([rotation, -(rotation @ centre)[:, None]], -1), scale)


def _turn_up(up: Tensor) -> Tensor:
    """(3, 3) rotation whose last row is the unit vector `up`."""
    spare = torch.eye(3).to(up)[up.abs().argmin()]
    x = torch.nn.functional.normalize(torch.linalg.cross(spare, up), dim=0)
    return torch.stack([x, torch.linalg.cross(up, x), up])
