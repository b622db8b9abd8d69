"""Colours for points of a hull, from the photographs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from visdom_plugin.cameras import Cameras, project
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.raycast import cast

_GREY = 0.5


def colour_points(hull: Hull, points: Tensor, cameras: Cameras, images: Sequence[Tensor]) -> Tensor:
    """Mean colour over the views that see each point, the hull itself being the only thing in the way.

    A point that the hull hides from every view takes the mean over all views that have it in their frame; one
    outside every frame is grey.

    Args:
        points: (n, 3) world frame, CPU.
        cameras: (N,) cameras.
        images: N tensors (H, W, 3), uint8 or float in [0, 1].

    Returns:
        (n, 3) float32 in [0, 1].
    """
    points = points.detach().double().cpu()
    # Points on the surface lie up to a voxel's diagonal from where the ray meets the first voxel.
    slack = 2.0 * hull.voxel_size
    sums = torch.zeros(2, len(points), 3)
    counts = torch.zeros(2, len(points))
    for view, image in enumerate(images):
        camera = cameras[view].to("cpu", torch.float64)
        uv, depth = project(camera, points)
        width, height = int(camera.width), int(camera.height)
        inside = (depth > 0) & (uv >= 0).all(-1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        if not inside.any():
            continue
        index = torch.where(inside[:, None], uv, 0.0).long()
        colour = image.detach().cpu()[index[:, 1], index[:, 0]]
        colour = colour.float() / 255 if colour.dtype == torch.uint8 else colour.float()
        offsets = points - camera.centres
        crossing = cast(hull, camera.centres, offsets)
        clear = inside & (~crossing.hit | ((1 - crossing.t_first) * offsets.norm(dim=-1) <= slack))
        for row, chosen in enumerate((clear, inside)):
            sums[row] += torch.where(chosen[:, None], colour, 0.0)
            counts[row] += chosen
    means = sums / counts.clamp_min(1)[..., None]
    best = torch.where((counts[0] > 0)[:, None], means[0], means[1])
    return torch.where((counts[1] > 0)[:, None], best, _GREY).clamp(0, 1)
