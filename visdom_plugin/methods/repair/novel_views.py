"""Views to repair: where they stand, away from the training cameras, and how much each counts."""

from __future__ import annotations

import math

import torch
from torch import Generator

from visdom_plugin.geometry.camera_paths import interpolate
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.methods.repair.configs import RepairConfig
from visdom_plugin.methods.splats.pseudo_views import fit_ellipse


class NovelViews:
    """Places for views that nobody photographed. They come from the training cameras alone, never from test
    cameras.

    Args:
        cameras: (N,) training cameras, N at least 2.
    """

    def __init__(self, cameras: Cameras, config: RepairConfig):
        self.cameras, self.config = cameras.to("cpu"), config
        self.look_at = look_at_point(self.cameras)
        self.centres = self.cameras.centres.double()
        self.ellipse = fit_ellipse(self.cameras)
        local = (self.centres - self.ellipse.origin) @ self.ellipse.world_from_plane - self.ellipse.centre
        x, y = (local[:, :2] / self.ellipse.half_axes.clamp_min(1e-12)).unbind(-1)
        self.angles = torch.atan2(y, x).remainder(2 * math.pi).sort().values
        apart = torch.cdist(self.centres, self.centres).sort(-1).values
        # The third-smallest, of which the smallest is the camera's own.
        self.reach = 1.2 * float(apart[:, min(2, len(self.centres) - 1)].max())

    def draw(self, generator: Generator) -> Cameras:
        """One camera, around the middle between two neighbours, or between any two."""
        away = 0.5 + self.config.away * (float(torch.rand((), generator=generator)) - 0.5) / 2
        if self.config.novel_views == "between":
            first, second = torch.randperm(len(self.cameras), generator=generator)[:2].tolist()
            return interpolate(self.cameras[first], self.cameras[second], away, self.look_at)
        i = int(torch.randint(len(self.angles), (), generator=generator))
        start, end = self.angles[i], self.angles[(i + 1) % len(self.angles)]
        gap = (end - start).remainder(2 * math.pi)
        return self.ellipse.camera(start + away * gap)

    def weight(self, camera: Cameras) -> float:
        """From 0 at a training camera to 1 far from all of them."""
        nearest = float((self.centres - camera.centres.to(self.centres)).norm(dim=-1).min())
        return min(1.0, 2 * nearest / self.reach) if self.reach > 0 else 1.0
