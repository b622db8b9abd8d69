"""Colours for points of a hull, from the photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import cast

_GREY = 0.5
_SLACK = 0.5
"""How far a float image may leave [0, 1]: resampling overshoots, another range does not stay that close."""


def check_images(images: Sequence[Tensor | np.ndarray], cameras: Cameras) -> list[Tensor]:
    """The photographs as tensors that `colour_points` takes.

    Args:
        images: N tensors or arrays (H, W, 3) of their cameras' sizes; integers in 0..255 or floats in [0, 1].
        cameras: (N,) cameras.

    Raises:
        ConfigError: for another number of images than cameras, or an image of another kind, size or range.
    """
    images = list(images)
    if len(images) != len(cameras):
        raise ConfigError(
            f"there are {len(images)} images and {len(cameras)} cameras",
            where="images",
            todo="pass one image (H, W, 3) per training camera, in the cameras' order",
        )
    sizes = zip(cameras.height.tolist(), cameras.width.tolist(), strict=True)
    return [_check_image(*each) for each in zip(images, sizes, range(len(images)), strict=True)]


def _check_image(image: Tensor | np.ndarray, size: tuple[int, int], view: int) -> Tensor:
    where = f"images[{view}]"
    try:
        # torch knows no negative strides, which BGR turned to RGB has.
        image = torch.as_tensor(np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"the image is {type(image).__name__}, which is no tensor", where=where, cause=str(error)
        ) from error
    if image.shape != (*size, 3):
        raise ConfigError(
            f"the image has shape {tuple(image.shape)}, its camera's is {(*size, 3)}",
            where=where,
            cause="channels first, an alpha channel, or another resolution than the cameras'",
            todo="pass images (H, W, 3) of the cameras' size; cameras.resized(width, height) changes that",
        )
    if image.dtype != torch.uint8:
        low, high = (float(x) for x in image.detach().float().aminmax())
        least, most = (-_SLACK, 1 + _SLACK) if image.is_floating_point() else (0, 255)
        if not (least <= low and high <= most):
            raise ConfigError(
                f"the {image.dtype} image goes from {low:g} to {high:g}",
                where=where,
                cause="another range: integers are 0 to 255, floats 0 to 1",
                todo="bring the image to one of the two",
            )
    return image


def colour_points(hull: Hull, points: Tensor, cameras: Cameras, images: Sequence[Tensor]) -> Tensor:
    """Mean colour over the views that see each point, the hull itself being the only thing in the way.

    A point that the hull hides from every view takes the mean over all views that have it in their frame; one
    outside every frame is grey.

    Args:
        points: (n, 3) world frame, CPU.
        cameras: (N,) cameras.
        images: N tensors (H, W, 3) of their cameras' sizes; integers in 0..255 or floats in [0, 1].

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
        width, height = camera.size
        inside = (depth > 0) & (uv >= 0).all(-1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        if not inside.any():
            continue
        index = torch.where(inside[:, None], uv, 0.0).long()
        colour = image.detach().cpu()[index[:, 1], index[:, 0]]
        colour = colour.float() if colour.is_floating_point() else colour.float() / 255
        offsets = points - camera.centres
        crossing = cast(hull, camera.centres, offsets)
        clear = inside & (~crossing.hit | ((1 - crossing.t_first) * offsets.norm(dim=-1) <= slack))
        for row, chosen in enumerate((clear, inside)):
            sums[row] += torch.where(chosen[:, None], colour, 0.0)
            counts[row] += chosen
    means = sums / counts.clamp_min(1)[..., None]
    best = torch.where((counts[0] > 0)[:, None], means[0], means[1])
    return torch.where((counts[1] > 0)[:, None], best, _GREY).clamp(0, 1)
