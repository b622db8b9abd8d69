"""Views that nobody photographed, between the training cameras, and their rays that miss the hull."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.camera_paths import draw_between
from visdom_plugin.geometry.cameras import Cameras, pixel_radius
from visdom_plugin.geometry.pixel_rays import rays_of_pixels
from visdom_plugin.geometry.rotations import slerp
from visdom_plugin.hooks.protocols import EmptyRays
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import cast

VIEWS = 64
"""Views "between" training cameras, made once."""
LONGEST_SIDE = 256
"""Pixels of a virtual view along its longer side, at most: the rays of a larger one are not needed all."""


def nearest_pairs(cameras: Cameras) -> list[tuple[int, int]]:
    """Each training camera (N,) with its two nearest ones by position, each pair once, in ascending order."""
    centres = cameras.centres.double()
    apart = torch.cdist(centres, centres).fill_diagonal_(torch.inf)
    near = apart.argsort(dim=-1, stable=True)[:, : min(2, len(cameras) - 1)]
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})


def midpoint_views(cameras: Cameras) -> list[Cameras]:
    """The view halfway between each training camera and its two nearest ones, N to 2 N of them.

    As the VisDom authors' release has them: rotations halfway along the shortest arc, positions in the middle of
    the straight line, inside the cameras' ring; intrinsics and size of the first camera.
    """
    first = cameras[0]
    made = []
    for i, j in nearest_pairs(cameras):
        motion = cameras.world_from_camera[i].clone()
        motion[:3, :3] = slerp(motion[:3, :3], cameras.world_from_camera[j, :3, :3], motion.new_tensor(0.5))
        motion[:3, 3] = (cameras.centres[i] + cameras.centres[j]) / 2
        made.append(Cameras(first.intrinsics, motion, first.width, first.height))
    return made


def virtual_views(cameras: Cameras, kind: Literal["between", "midpoints"], look_at: Tensor) -> list[Cameras]:
    """Views between the training cameras (N,), N >= 2; the same for every call.

    Args:
        kind: "midpoints", see `midpoint_views`; "between", `VIEWS` random places on the way between random pairs.
        look_at: (3,) what views "between" keep where it is seen.
    """
    if kind == "midpoints":
        return midpoint_views(cameras)
    return [draw_between(cameras, look_at, torch.Generator().manual_seed(i)) for i in range(VIEWS)]


class OutsideRays:
    """Rays of views that miss a hull, found at the first question and kept: 16 bytes for each.

    Args:
        hull: the visible domain.
        views: single cameras.
    """

    def __init__(self, hull: Hull, views: Sequence[Cameras]):
        self.hull, self.views = hull, views
        self._found: tuple[Cameras, Tensor, Tensor, Tensor] | None = None

    def draw(self, n: int, generator: Generator | None, device: torch.device) -> EmptyRays:
        """`n` rays drawn with replacement, every one alike; none where all rays meet the hull."""
        cameras, radii, view, pixel = self._found = self._found or self._find()
        chosen = torch.randint(max(len(view), 1), (n if len(view) else 0,), generator=generator)
        which = view[chosen]
        rays = rays_of_pixels(cameras, which, pixel[chosen])
        return EmptyRays(*(x.to(device) for x in (*rays, radii[which])))

    def _find(self) -> tuple[Cameras, Tensor, Tensor, Tensor]:
        shrunk, views, pixels = [], [], []
        for i, camera in enumerate(self.views):
            width, height = camera.size
            ratio = min(1.0, LONGEST_SIDE / max(width, height))
            shrunk.append(camera.resized(max(1, round(ratio * width)), max(1, round(ratio * height))))
            all_pixels = torch.arange(shrunk[-1].size[0] * shrunk[-1].size[1])
            rays = rays_of_pixels(shrunk[-1][None], torch.zeros_like(all_pixels), all_pixels)
            pixels.append(all_pixels[~cast(self.hull, *rays).hit])
            views.append(torch.full_like(pixels[-1], i))
        radii = torch.stack([pixel_radius(camera) for camera in self.views])
        return Cameras.stack(shrunk), radii, torch.cat(views), torch.cat(pixels)
