"""Square pictures of the size that the networks see, and cameras that take them."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras


def centre_square(image: Tensor, size: int) -> Tensor:
    """(size, size, 3) of the middle of a picture (H, W, 3); what lies beyond it is white."""
    height, width = image.shape[:2]
    square = image.new_ones(size, size, 3)
    (top, down, rows), (left, right, columns) = _overlap(height, size), _overlap(width, size)
    square[down : down + rows, right : right + columns] = image[top : top + rows, left : left + columns]
    return square


def centre_camera(camera: Cameras, size: int) -> Cameras:
    """The camera, of shape (), that sees the middle square of its picture, and more where that is smaller."""
    width, height = camera.size
    shift = camera.intrinsics.new_zeros(3, 3)
    for axis, extent in enumerate((width, height)):
        start, pad, _ = _overlap(extent, size)
        shift[axis, 2] = pad - start
    side = torch.full_like(camera.width, size)
    return Cameras(camera.intrinsics + shift, camera.world_from_camera, side, side)


def as_bytes(image: Tensor) -> Tensor:
    """A picture of [0, 1], clamped, as uint8."""
    return (image.detach().clamp(0, 1) * 255).round().byte()


def _overlap(extent: int, size: int) -> tuple[int, int, int]:
    """Where the square begins in the picture, where the picture begins in the square, and what both have."""
    start = max(extent // 2 - size // 2, 0)
    pad = max((size - extent) // 2, 0)
    return start, pad, min(extent - start, size - pad)
