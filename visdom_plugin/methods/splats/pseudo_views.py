"""Views that nobody photographed, drawn from the training cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.camera_paths import draw_between, look_at_camera
from visdom_plugin.geometry.cameras import Cameras, look_at_point

HEIGHT_VARIATION = 0.1
"""Share of the cameras' own spread in height that the ellipse keeps (CoR-GS, after mip-NeRF 360's test paths)."""


@dataclass(frozen=True)
class Ellipse:
    """A closed path round what the cameras look at, in the plane in which they spread most."""

    world_from_plane: Tensor
    """(3, 3) rotation; its third column is normal to the plane, on the side of the cameras' up."""
    origin: Tensor
    """(3,) mean of the camera centres, world frame."""
    centre: Tensor
    """(3,) the ellipse's, in the plane's axes from the origin; its height is that of the look-at point."""
    half_axes: Tensor
    """(2,) along the plane's axes, scene units."""
    heights: tuple[float, float]
    """Lowest and highest above the origin, scene units."""
    up: Tensor
    """(3,) world frame."""
    pattern: Cameras
    """The camera whose intrinsics and size the views have, shape ()."""

    def camera(self, angle: Tensor | float) -> Cameras:
        """The camera at an angle in radians, looking at the look-at point."""
        angle = torch.as_tensor(angle, dtype=torch.float64)
        x, y = torch.cos(angle), torch.sin(angle)
        low, high = self.heights
        height = low + (high - low) * (0.5 + 0.5 * x)
        local = torch.stack(
            [self.centre[0] + self.half_axes[0] * x, self.centre[1] + self.half_axes[1] * y, height]
        )
        position, target = (self.origin + self.world_from_plane @ v for v in (local, self.centre))
        motion = look_at_camera(position, target, self.up)
        one = self.pattern
        return Cameras(one.intrinsics, motion.to(one.world_from_camera), one.width, one.height)


def fit_ellipse(cameras: Cameras) -> Ellipse:
    """The ellipse of CoR-GS's pseudo views in captures all round a scene.

    Axes are the principal ones of the camera centres; half axes are the 90th percentiles of the centres'
    distances from the look-at point along them; heights vary by a tenth of the centres' own.

    Args:
        cameras: (N,) training cameras; the first gives intrinsics and size.
    """
    centres = cameras.centres.double()
    origin = centres.mean(0)
    mean_up = -cameras.world_from_camera[:, :3, 1].double().mean(0)
    # From the most spread to the least, which is the plane's normal.
    axes = torch.linalg.svd(centres - origin).Vh.T.clone()
    axes[:, 2] *= torch.where(mean_up @ axes[:, 2] < 0, -1.0, 1.0)
    axes[:, 0] = torch.linalg.cross(axes[:, 1], axes[:, 2])
    local = (centres - origin) @ axes
    centre = (look_at_point(cameras).double() - origin) @ axes
    # Up is the axis nearest to the cameras' own: mostly the normal, another one for an arc of views in a wall.
    up = axes[:, (mean_up @ axes).abs().argmax()]
    low, high = (HEIGHT_VARIATION * float(torch.quantile(local[:, 2], q)) for q in (0.1, 0.9))
    return Ellipse(
        world_from_plane=axes,
        origin=origin,
        centre=centre,
        half_axes=torch.quantile((local - centre)[:, :2].abs(), 0.9, dim=0),
        heights=(low, high),
        up=up * torch.where(mean_up @ up < 0, -1.0, 1.0),
        pattern=cameras[0],
    )


def draw_on_ellipse(ellipse: Ellipse, generator: Generator) -> Cameras:
    """A camera at a uniform angle."""
    return ellipse.camera(2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64))


class PseudoViews:
    """The pseudo views of a run, of the training cameras (N,), N >= 2.

    Args:
        kind: "ellipse" for an ellipse fitted to the cameras, "between" for places between two of them.
    """

    def __init__(self, kind: Literal["ellipse", "between"], cameras: Cameras):
        self.kind, self.cameras = kind, cameras
        self.look_at, self.ellipse = look_at_point(cameras), fit_ellipse(cameras)

    def draw(self, generator: Generator) -> Cameras:
        """One camera, drawn with a CPU generator."""
        if self.kind == "ellipse":
            return draw_on_ellipse(self.ellipse, generator)
        return draw_between(self.cameras, self.look_at, generator)
