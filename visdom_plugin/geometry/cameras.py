"""Pinhole cameras and rays, batched over leading dimensions.

Conventions, everywhere in this project: camera axes are OpenCV's (x right, y down, z forward); matrices are
named as maps (`world_from_camera` takes camera coordinates to world coordinates); pixel coordinates `uv_px`
have their origin at the corner of the image, so that the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_checks import check_matrices


class Rays(NamedTuple):
    """Half-lines origin + t * direction, t >= 0."""

    origins: Tensor
    """(..., 3) world frame."""
    directions: Tensor
    """(..., 3) unit length, world frame."""


@dataclass(frozen=True)
class Cameras:
    """A batch of pinhole cameras of any leading shape, each with its own size and principal point."""

    intrinsics: Tensor
    """(..., 3, 3) pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    world_from_camera: Tensor
    """(..., 4, 4) rigid motion, OpenCV axes."""
    width: Tensor
    """(...) int64 pixels."""
    height: Tensor
    """(...) int64 pixels."""

    @classmethod
    def from_matrices(cls, K, world_from_camera, *, width, height, convention: str = "opencv") -> Cameras:
        """Cameras from arrays or tensors, checked.

        Args:
            K: (..., 3, 3) intrinsics in pixels, zero skew.
            world_from_camera: (..., 4, 4) or (..., 3, 4) camera-to-world motion. This and K may be lists of
                tensors or arrays, too.
            width, height: image size in pixels, an int or one per camera (...).
            convention: axes of `world_from_camera`: "opencv" (y down, z forward) or "opengl" (y up, z backward).

        Returns:
            Cameras in OpenCV axes, in the motions' floating dtype (float32 for half precision, float64 for
            integers), on their device, outside any graph.

        Raises:
            SceneError: for NaN or infinite numbers; a last row of a motion other than (0, 0, 0, 1), or of K other
                than (0, 0, 1), as transposed matrices have them; a rotation part that is not a rotation; a skewed
                or non-positive focal length; K in fractions of the image or angles; an empty image; an unknown
                convention; or counts that do not match.
        """
        motion = _as_tensor(world_from_camera)
        motion = motion if motion.is_floating_point() else motion.double()
        motion = motion.float() if motion.dtype in (torch.float16, torch.bfloat16) else motion
        intrinsics = _as_tensor(K).to(motion)
        if convention not in ("opencv", "opengl"):
            raise SceneError(
                f"unknown camera convention {convention!r}",
                todo='say convention="opencv" (y down, z forward) or convention="opengl" (y up, z backward)',
                topic="poses",
            )
        if intrinsics.shape[-2:] != (3, 3) or motion.shape[-2:] not in ((4, 4), (3, 4)):
            raise SceneError(
                f"camera matrices have shapes {tuple(intrinsics.shape)} and {tuple(motion.shape)}",
                todo="pass K as (..., 3, 3) and world_from_camera as (..., 4, 4) or (..., 3, 4)",
                topic="poses",
            )
        if motion.shape[-2] == 3:
            last = motion.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*motion.shape[:-2], 1, 4)
            motion = torch.cat([motion, last], -2)
        if convention == "opengl":
            motion = motion * motion.new_tensor([1.0, -1.0, -1.0, 1.0])
        try:
            batch = torch.broadcast_shapes(intrinsics.shape[:-2], motion.shape[:-2])
        except RuntimeError as error:
            raise SceneError(
                f"the intrinsics are for cameras of shape {tuple(intrinsics.shape[:-2])}, "
                f"world_from_camera for {tuple(motion.shape[:-2])}",
                todo="pass intrinsics (N, 3, 3), one per camera, or (3, 3) for all",
                topic="poses",
            ) from error
        size = _sizes(batch, motion.device, width=width, height=height)
        cameras = cls(intrinsics.expand(*batch, 3, 3), motion.expand(*batch, 4, 4), *size)
        check_matrices(cameras.intrinsics, cameras.world_from_camera, cameras.width, cameras.height)
        return cameras

    @classmethod
    def stack(cls, cameras: Sequence[Cameras]) -> Cameras:
        """Joins cameras of equal shape along a new first dimension."""
        names = ("intrinsics", "world_from_camera", "width", "height")
        return cls(*(torch.stack([getattr(c, name) for c in cameras]) for name in names))

    @property
    def shape(self) -> torch.Size:
        """Leading shape of the batch; empty for one camera."""
        return self.width.shape

    def __len__(self) -> int:
        return self.width.shape[0]

    def __getitem__(self, index) -> Cameras:
        K, motion = self.intrinsics[index], self.world_from_camera[index]
        return Cameras(K, motion, self.width[index], self.height[index])

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of one camera, shape (), as numbers; read from the device once."""
        return int(self.width), int(self.height)

    def to(self, device=None, dtype: torch.dtype | None = None) -> Cameras:
        """The same cameras on another device or in another floating dtype."""
        K, motion = (x.to(device=device, dtype=dtype) for x in (self.intrinsics, self.world_from_camera))
        width, height = (x.to(device=device) for x in (self.width, self.height))
        return self._hand_size(Cameras(K, motion, width, height))

    def _hand_size(self, other: Cameras) -> Cameras:
        """`other`, which has the same size and need not read it from the device again."""
        if not self.shape and (self.width.device.type == "cpu" or "size" in self.__dict__):
            other.__dict__["size"] = self.size
        return other

    @property
    def centres(self) -> Tensor:
        """(..., 3) positions in the world frame."""
        return self.world_from_camera[..., :3, 3]

    @property
    def forward(self) -> Tensor:
        """(..., 3) unit viewing directions (camera +z) in the world frame."""
        return self.world_from_camera[..., :3, 2]

    @property
    def camera_from_world(self) -> Tensor:
        """(..., 4, 4) rigid motion from world to camera coordinates."""
        rotation = self.world_from_camera[..., :3, :3].mT
        translation = -(rotation @ self.world_from_camera[..., :3, 3:])
        return torch.cat([torch.cat([rotation, translation], -1), self.world_from_camera[..., 3:, :]], -2)

    def relative_to(self, origin: Tensor) -> Cameras:
        """The same cameras in the frame that has its origin at `origin` (3,) float64, with the same axes."""
        motion = self.world_from_camera.clone()
        motion[..., :3, 3] = (self.centres.double() - origin.to(motion.device)).to(motion)
        return self._hand_size(Cameras(self.intrinsics, motion, self.width, self.height))

    def in_units(self, length: float) -> Cameras:
        """The same cameras with positions counted in lengths of that many scene units."""
        motion = self.world_from_camera.clone()
        motion[..., :3, 3] = self.centres.double() / length
        return self._hand_size(Cameras(self.intrinsics, motion, self.width, self.height))

    def resized(self, width, height) -> Cameras:
        """Cameras whose images were resampled to another size, each axis by its own ratio."""
        width, height = _sizes(self.shape, self.width.device, width=width, height=height)
        sizes = (width.double() / self.width, height.double() / self.height)
        ratio = torch.stack([*sizes, torch.ones_like(sizes[0])], -1)
        K = self.intrinsics * ratio[..., None].to(self.intrinsics)
        return Cameras(K, self.world_from_camera, width, height)


def _as_tensor(value) -> Tensor:
    if isinstance(value, list | tuple) and len(value) and isinstance(value[0], Tensor | np.ndarray):
        value = torch.stack([_as_tensor(part) for part in value])
    if isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value)  # torch knows no negative strides
    return torch.as_tensor(value).detach()


def _sizes(batch: torch.Size, device, **sizes) -> list[Tensor]:
    """Each of the named sizes as int64 of shape `batch`."""
    found = []
    for name, value in sizes.items():
        value = torch.as_tensor(value, device=device).to(torch.int64)
        try:
            found.append(value.expand(batch))
        except RuntimeError as error:
            raise SceneError(
                f"{name} has shape {tuple(value.shape)} for cameras of shape {tuple(batch)}",
                todo=f"pass one {name} for all cameras, or one per camera",
            ) from error
    return found


def require_batch(cameras, where: str) -> None:
    """Refuses anything but a batch (N,) of one camera or more.

    Raises:
        SceneError: for a sequence of single cameras, a single camera, an empty or a deeper batch.
    """
    if not isinstance(cameras, Cameras):
        several = isinstance(cameras, Sequence) and all(isinstance(c, Cameras) for c in cameras)
        kind = f"{type(cameras).__name__} of {len(cameras)} Cameras" if several else type(cameras).__name__
        raise SceneError(
            f"cameras are a {kind}, not one batch Cameras of shape (N,)",
            where=where,
            todo="join single cameras with Cameras.stack(list), or make them with Cameras.from_matrices",
        )
    if len(cameras.shape) != 1 or len(cameras) == 0:
        raise SceneError(
            f"cameras have shape {tuple(cameras.shape)}, not (N,) with N of 1 or more",
            where=where,
            todo="pass the batch of all cameras; cameras[None] is a batch of a single one",
        )


def project(cameras: Cameras, points: Tensor) -> tuple[Tensor, Tensor]:
    """Where points fall in the images.

    Args:
        cameras: (...) cameras.
        points: (..., P, 3) world frame; leading dimensions broadcast with the cameras'.

    Returns:
        uv_px (..., P, 2) pixels, and depth (..., P) along the camera's z axis in scene units. Where
        depth <= 0 the point lies behind the camera and uv_px means nothing.
    """
    world = cameras.camera_from_world.to(points)
    local = points @ world[..., :3, :3].mT + world[..., None, :3, 3]
    depth = local[..., 2]
    homogeneous = local @ cameras.intrinsics.to(points).mT
    safe = torch.where(depth.abs() < 1e-12, torch.full_like(depth, 1e-12), depth)
    return homogeneous[..., :2] / safe[..., None], depth


def rays_of(cameras: Cameras, uv_px: Tensor | None = None) -> Rays:
    """Rays through pixels.

    Args:
        cameras: (...) cameras.
        uv_px: (..., P, 2) pixel coordinates. None, for a single camera only, means every pixel centre.

    Returns:
        Rays of shape (..., P, 3), or (H, W, 3) without `uv_px`.
    """
    image_shape = None
    if uv_px is None:
        if cameras.shape:
            raise ValueError(
                "rays_of needs uv_px for a batch of cameras; index one camera for all its pixels"
            )
        width, height = cameras.size
        image_shape = (height, width, 3)
        rows = torch.arange(height, device=cameras.intrinsics.device, dtype=cameras.intrinsics.dtype) + 0.5
        columns = torch.arange(width, device=cameras.intrinsics.device, dtype=cameras.intrinsics.dtype) + 0.5
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        uv_px = torch.stack([u, v], -1).reshape(-1, 2)
    K = cameras.intrinsics.to(uv_px)
    x = (uv_px[..., 0] - K[..., None, 0, 2]) / K[..., None, 0, 0]
    y = (uv_px[..., 1] - K[..., None, 1, 2]) / K[..., None, 1, 1]
    local = torch.stack([x, y, torch.ones_like(x)], -1)
    motion = cameras.world_from_camera.to(uv_px)
    directions = torch.nn.functional.normalize(local @ motion[..., :3, :3].mT, dim=-1)
    origins = motion[..., None, :3, 3].expand_as(directions)
    if image_shape is not None:
        return Rays(origins.reshape(image_shape), directions.reshape(image_shape))
    return Rays(origins, directions)


def pixel_radius(cameras: Cameras) -> Tensor:
    """Radius of a pixel's cone at distance 1: the pixel's width times 2 / sqrt(12) (mip-NeRF).

    Args:
        cameras: (...) cameras.

    Returns:
        (...) float32.
    """
    return (2 / math.sqrt(12) / cameras.intrinsics[..., 0, 0]).float()


def look_at_point(cameras: Cameras) -> Tensor:
    """The point closest, in least squares, to all optical axes: what the capture is about.

    Cameras that all look the same way leave the depth open; a small pull towards the point at the cameras'
    own spread in front of them decides it.

    Args:
        cameras: (N,) cameras.

    Returns:
        (3,) world frame.
    """
    centres, forward = cameras.centres, cameras.forward
    spread = (centres - centres.mean(0)).norm(dim=-1).mean()
    spread = torch.where(spread > 0, spread, 1e-6)
    across = torch.eye(3).to(centres) - forward[:, :, None] * forward[:, None, :]
    prior = (centres + spread * forward).mean(0)
    pull = 1e-6 * len(cameras)
    matrix = across.sum(0) + pull * torch.eye(3).to(centres)
    return torch.linalg.solve(matrix, (across @ centres[:, :, None]).sum(0)[:, 0] + pull * prior)
