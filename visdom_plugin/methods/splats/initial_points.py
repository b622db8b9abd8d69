"""Where Gaussians start: a hook's points, the hull's inside, points of structure from motion, or a random box."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras, look_at_point, project
from visdom_plugin.geometry.local_frame import mean_distance
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Views

BOX_HALF_SIDE = 0.325
"""Of the random box, in mean camera distances: 3DGS's 1.3 for Blender scenes, whose cameras are 4 away."""


def draw_points(
    hooks: Sequence[GaussianHook], hull: Hull | None, views: Views, n: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """Points of the first hook; without one, in the hull; without a hull, those of structure from motion.

    Points in the hull, or in `hull.inner` where it has one, have the views' mean colours. Of structure from
    motion, `n` points are drawn. Without any, points are drawn in a box around what the cameras look at.

    Returns:
        xyz (N, 3) float32 world frame and rgb (N, 3) in [0, 1], N at most n.
    """
    if hooks:
        return hooks[0].initial_points(n, generator)
    if hull is not None:
        xyz = (hull.inner or hull).sample_inside(n, generator).float()
        return xyz, mean_masked_colour(xyz, views)
    if views.points is not None and len(views.points[0]):
        xyz, rgb = views.points
        chosen = torch.randperm(len(xyz), generator=generator)[:n].sort().values
        return xyz[chosen].float(), rgb[chosen].float()
    return draw_box(views.cameras, n, generator)


def draw_box(cameras: Cameras, n: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Grey points, uniform in a cube around what the cameras look at (3DGS without a point cloud).

    Returns:
        xyz (n, 3) float32 world frame and rgb (n, 3).
    """
    centre = look_at_point(cameras)
    half_side = BOX_HALF_SIDE * mean_distance(cameras, centre)
    unit = 2 * torch.rand(n, 3, generator=generator, dtype=torch.float64) - 1
    return (centre.double() + half_side.double() * unit).float(), torch.full((n, 3), 0.5)


def mean_masked_colour(points: Tensor, views: Views) -> Tensor:
    """GaussianObject's initial colours: the mean over all views of the black-masked photograph.

    Args:
        points: (N, 3) world frame.

    Returns:
        (N, 3) rgb in [0, 1]; a view that does not see a point counts as black.
    """
    total = torch.zeros(len(points), 3)
    for i in range(len(views)):
        uv, depth = project(views.cameras[i].to(dtype=torch.float32), points.float())
        image = views.images[i].float() / 255 * views.demanded(i)[..., None]
        height, width = image.shape[:2]
        grid = 2 * uv / uv.new_tensor([width, height]) - 1
        sampled = torch.nn.functional.grid_sample(
            image.permute(2, 0, 1)[None], grid[None, None], align_corners=False
        )[0, :, 0].T
        total += torch.where((depth > 0)[:, None], sampled, 0)
    return total / max(len(views), 1)
