"""Rays through single pixels of many cameras, as the steps of radiance fields draw them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras, Rays, rays_of

PIXELS_PER_PIECE = 4096


def rays_of_pixels(cameras: Cameras, view: Tensor, pixel: Tensor) -> Rays:
    """Rays through the centres of single pixels of a batch of cameras.

    Args:
        cameras: (N,) cameras.
        view: (n,) int64 camera of each pixel.
        pixel: (n,) int64 its number in the image, row by row.

    Returns:
        Rays (n, 3) float32, each the same whichever pixels are asked for beside it.
    """
    if pixel.device.type != "cpu":
        return _rays_torch(cameras, view, pixel)
    given = (view, pixel, cameras.width, cameras.intrinsics.double(), cameras.world_from_camera.double())
    origins, directions = (torch.empty(len(pixel), 3) for _ in range(2))
    arrays = [x.contiguous().numpy() for x in (*given, origins, directions)]
    parallel_for(_find_rays, len(pixel), PIXELS_PER_PIECE, *arrays)
    return Rays(origins, directions)


def _rays_torch(cameras: Cameras, view: Tensor, pixel: Tensor) -> Rays:
    chosen = cameras[view]
    uv = torch.stack([pixel % chosen.width, pixel // chosen.width], -1)
    rays = rays_of(chosen, (uv + 0.5).to(chosen.intrinsics)[:, None])
    return Rays(rays.origins[:, 0].float(), rays.directions[:, 0].float())


@kernel(error_model="numpy")
def _find_rays(begin, end, view, pixel, width, intrinsics, motions, origins, directions):
    """In float64, rounded at the end."""
    for i in range(begin, end):
        v = view[i]
        x = (pixel[i] % width[v] + 0.5 - intrinsics[v, 0, 2]) / intrinsics[v, 0, 0]
        y = (pixel[i] // width[v] + 0.5 - intrinsics[v, 1, 2]) / intrinsics[v, 1, 1]
        squared = 0.0
        for axis in range(3):
            along = motions[v, axis, 0] * x + motions[v, axis, 1] * y + motions[v, axis, 2]
            squared += along * along
        scale = 1.0 / math.sqrt(squared)
        for axis in range(3):
            along = motions[v, axis, 0] * x + motions[v, axis, 1] * y + motions[v, axis, 2]
            origins[i, axis] = motions[v, axis, 3]
            directions[i, axis] = along * scale
