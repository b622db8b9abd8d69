"""Errors put into the built-in scene's training views on purpose: poses that are off, masks that are wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from datamodules.synthetic.config import SyntheticConfig
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.seeding import generator


def disturb_poses(cameras: Cameras, config: SyntheticConfig) -> Cameras:
    """Cameras that stand and look a little beside where the photographs were taken.

    Rotations are about random axes by normally distributed angles (`rotation_noise_deg`), moves are normally
    distributed in space (`translation_noise` times the distance to the look-at point).
    """
    if not (config.rotation_noise_deg or config.translation_noise):
        return cameras
    draw = generator(config.seed, "synthetic", "poses")
    axis = torch.nn.functional.normalize(
        torch.randn(len(cameras), 3, generator=draw, dtype=torch.float64), dim=-1
    )
    angle = torch.randn(len(cameras), 1, generator=draw, dtype=torch.float64)
    half = angle * math.radians(config.rotation_noise_deg) / 2
    turn = matrix_from_quaternion(torch.cat([half.cos(), half.sin() * axis], -1))
    distance = (cameras.centres - look_at_point(cameras)).norm(dim=-1, keepdim=True)
    # Three components: the length of the move has the asked-for spread.
    move = torch.randn(len(cameras), 3, generator=draw, dtype=torch.float64) / math.sqrt(3)
    motion = cameras.world_from_camera.clone()
    motion[:, :3, :3] = motion[:, :3, :3] @ turn
    motion[:, :3, 3] += move * distance * config.translation_noise
    return Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)


def disturb_masks(masks: Sequence[Tensor], config: SyntheticConfig) -> list[Tensor]:
    """Masks eroded, then dilated (by discs of `erode_px` and `dilate_px`), then with pixels turned over."""
    changed = []
    for i, mask in enumerate(masks):
        mask = _grow(~mask, config.erode_px).logical_not() if config.erode_px else mask
        mask = _grow(mask, config.dilate_px) if config.dilate_px else mask
        if config.flip_fraction:
            draw = generator(config.seed, "synthetic", "flips", i)
            mask = mask ^ (torch.rand(mask.shape, generator=draw) < config.flip_fraction)
        changed.append(mask)
    return changed


def _grow(mask: Tensor, radius: int) -> Tensor:
    """Every pixel within `radius` (Euclidean) of a True one; nothing comes in over the image's border."""
    import cv2

    if not mask.any():
        return mask
    away = cv2.distanceTransform((~mask).numpy().astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return torch.from_numpy(away <= radius + 1e-3)
