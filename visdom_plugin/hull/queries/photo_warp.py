"""Photographs warped over a shape's surface into a view that nobody took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras, project, rays_of
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import depth_and_silhouette

NEARNESS = 8
"""A photograph counts by this power of the cosine between its direction to the surface and the new view's."""
TOLERANCE = 0.1
"""Standard deviation of the photographs' colours about their mean, at which trust in it falls to 1 / e."""
SLACK_VOXELS = 5.0
"""How far behind the surface that a photograph shows a point may lie and still be seen in it."""


@dataclass(frozen=True)
class WarpedView:
    """What photographs and a shape say of one view."""

    rgb: Tensor
    """(H, W, 3) float32 in [0, 1]; anything where trust is 0."""
    trust: Tensor
    """(H, W) float32 from 0, where no photograph shows the surface or they contradict each other, to 1."""
    silhouette: Tensor
    """(H, W) bool, True where the shape is seen."""


class PhotoWarp:
    """Warps photographs over a shape, each to where it sees the surface, blended by how near its direction is.

    Where the shape is wrong, photographs from different directions disagree, and trust is low.

    Args:
        shape: whose surface shows the photographs.
        cameras: (N,) their cameras.
        images: N tensors (H, W, 3), integers in 0..255 or floats in [0, 1].
        masks: N tensors (H, W) bool, True on the object: nothing else is warped.
    """

    def __init__(self, shape: Hull, cameras: Cameras, images: Sequence[Tensor], masks: Sequence[Tensor]):
        self.shape, self.cameras = shape, cameras.to("cpu", torch.float64)
        self.images, self.masks = [image.cpu() for image in images], [mask.cpu() for mask in masks]
        self.depths = [depth_and_silhouette(shape, self.cameras[i])[0] for i in range(len(cameras))]

    def draw(self, camera: Cameras) -> WarpedView:
        """The view of one camera, of shape ()."""
        camera = camera.to("cpu", torch.float64)
        depth, silhouette = depth_and_silhouette(self.shape, camera)
        rays = rays_of(camera)
        along = rays.directions @ camera.forward
        points = (rays.origins + rays.directions * (depth / along)[..., None])[silhouette]
        direction = torch.nn.functional.normalize(points - camera.centres, dim=-1)
        weights = torch.zeros(len(points))
        sums, squares = torch.zeros(len(points), 3), torch.zeros(len(points), 3)
        for i in range(len(self.images)):
            colour, weight = self._look(i, points, direction)
            weights += weight
            sums += weight[:, None] * colour
            squares += weight[:, None] * colour.square()
        mean = sums / weights.clamp_min(1e-9)[:, None]
        variance = (squares / weights.clamp_min(1e-9)[:, None] - mean.square()).clamp_min(0).mean(-1)
        trust = torch.where(weights > 1e-4, (-variance / TOLERANCE**2).exp(), 0.0)
        rgb = torch.zeros(*silhouette.shape, 3)
        rgb[silhouette] = mean.clamp(0, 1)
        trusted = torch.zeros(silhouette.shape)
        trusted[silhouette] = trust
        return WarpedView(rgb, trusted, silhouette)

    def _look(self, view: int, points: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (P, 3) of points in a photograph, and their weights (P,): 0 where it does not show them."""
        camera, image = self.cameras[view], self.images[view]
        height, width = image.shape[:2]
        uv, depth = project(camera, points)
        inside = (depth > 0) & (uv >= 0).all(-1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        x, y = torch.where(inside[:, None], uv, 0.0).long().unbind(-1)
        behind = depth - self.depths[view][y, x]
        seen = inside & self.masks[view][y, x] & (behind < SLACK_VOXELS * self.shape.voxel_size)
        scaled = image.float() if image.is_floating_point() else image.float() / 255
        grid = (2 * uv / uv.new_tensor([width, height]) - 1).float()
        colour = torch.nn.functional.grid_sample(
            scaled.permute(2, 0, 1)[None], grid[None, None], padding_mode="border", align_corners=False
        )[0, :, 0].T
        own = torch.nn.functional.normalize(points - camera.centres, dim=-1)
        cosine = (own * direction).sum(-1).clamp_min(0).float()
        return colour, torch.where(seen, cosine**NEARNESS, 0.0)
