"""Analytic scenes: balls and boxes seen by pinhole cameras, with exact silhouettes."""

from __future__ import annotations

import numpy as np
import torch

from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, rays_of


def ring(count: int, distance: float = 4.0, *, size: int = 96, focal: float = 1.2, seed: int = 0) -> Cameras:
    """Cameras around the origin at varied heights that look at it."""
    random = np.random.default_rng(seed)
    angle = np.arange(count) * 2 * np.pi / count + 0.1 * random.normal(size=count)
    height = random.uniform(-0.5, 0.6, count)
    flat = np.sqrt(1 - height**2)
    centres = distance * np.stack([flat * np.cos(angle), flat * np.sin(angle), height], -1)
    motion = look_at_camera(
        torch.from_numpy(centres), torch.zeros(count, 3).double(), torch.tensor([0.0, 0, 1]).double()
    )
    intrinsics = torch.tensor([[focal * size, 0, size / 2], [0, focal * size, size / 2], [0, 0, 1]]).double()
    return Cameras.from_matrices(intrinsics.expand(count, 3, 3), motion, width=size, height=size)


def random_cameras(random: np.random.Generator, count: int) -> Cameras:
    """Anywhere near the unit cube, also inside it, looking anywhere, rolled, with odd sizes and centres."""
    turn = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
    turn[np.linalg.det(turn) < 0, :, 0] *= -1
    motion = np.zeros((count, 3, 4))
    motion[:, :, :3], motion[:, :, 3] = turn, random.normal(size=(count, 3)) * random.choice([0.3, 1.5, 4.0])
    width, height = random.integers(20, 70, count), random.integers(20, 70, count)
    intrinsics = np.zeros((count, 3, 3))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = random.uniform(10, 120, count), random.uniform(10, 120, count)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = (
        random.uniform(-0.2, 1.2, count) * width,
        random.uniform(0.1, 1, count) * height,  # a centre within a pixel of the corner is refused
    )
    intrinsics[:, 2, 2] = 1
    return Cameras.from_matrices(
        intrinsics, motion, width=torch.from_numpy(width), height=torch.from_numpy(height)
    )


def random_masks(random: np.random.Generator, cameras: Cameras) -> list[np.ndarray]:
    """Blobs, full masks, empty masks and noise."""
    masks = []
    for width, height in zip(cameras.width.tolist(), cameras.height.tolist(), strict=True):
        y, x = np.mgrid[:height, :width]
        blob = np.hypot(x - random.uniform(0, width), y - random.uniform(0, height)) < random.uniform(3, 40)
        noise = random.random((height, width)) < random.random()
        kinds = [blob, blob, ~blob, noise, blob & noise, np.ones_like(blob), np.zeros_like(blob)]
        masks.append(kinds[random.choice(7, p=[0.3, 0.15, 0.2, 0.1, 0.1, 0.1, 0.05])])
    return masks


def ball_masks(cameras: Cameras, balls) -> list[torch.Tensor]:
    """Silhouettes of balls (centre, radius): the pixels whose centre's ray meets one."""
    masks = []
    for i in range(len(cameras)):
        rays = rays_of(cameras[i])
        mask = torch.zeros(rays.origins.shape[:2], dtype=torch.bool)
        for centre, radius in balls:
            offset = torch.tensor(centre, dtype=torch.float64) - rays.origins
            along = (offset * rays.directions).sum(-1)
            mask |= (along > 0) & (offset.square().sum(-1) - along.square() < radius**2)
        masks.append(mask)
    return masks


def box_masks(cameras: Cameras, low, high) -> list[torch.Tensor]:
    """Silhouettes of an axis-aligned box."""
    low, high = (torch.tensor(x, dtype=torch.float64) for x in (low, high))
    masks = []
    for i in range(len(cameras)):
        rays = rays_of(cameras[i])
        ends = torch.stack([(low - rays.origins) / rays.directions, (high - rays.origins) / rays.directions])
        near, far = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
        masks.append((near < far) & (far > 0))
    return masks


def moved(cameras: Cameras, rotation, scale: float, shift) -> Cameras:
    """The same cameras after the world was turned, scaled and shifted: x -> scale * rotation x + shift."""
    motion = cameras.world_from_camera.clone()
    rotation, shift = torch.as_tensor(rotation), torch.as_tensor(shift)
    motion[:, :3, :3] = rotation @ motion[:, :3, :3]
    motion[:, :3, 3] = scale * motion[:, :3, 3] @ rotation.mT + shift
    return Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)
