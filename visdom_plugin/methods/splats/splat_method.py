"""Base of the splatting methods: what they are handed, and the one set of Gaussians that is shown and exported."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import torch
from torch import Generator, Tensor

from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.geometry.local_frame import mean_distance
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.colour_correction import ColourCorrection, CorrectsColours
from visdom_plugin.methods.splats.common import scene_extent
from visdom_plugin.methods.splats.configs import HullStartConfig
from visdom_plugin.methods.splats.virtual_views import VirtualViews
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.seeding import generator
from visdom_plugin.splat.cpu.backend import warm_up
from visdom_plugin.splat.model import GaussianSet
from visdom_plugin.splat.ply import write_gaussians
from visdom_plugin.splat.rasterise import NEAR

Config = TypeVar("Config", bound=HullStartConfig)

SEEN_MARGIN = 0.5
"""How far outside of a picture, in its sizes, a centre may lie whose Gaussian still shows at its edge."""

log = logging.getLogger(__name__)


class SplatMethod(CorrectsColours, ABC, Generic[Config]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    fewest_views: ClassVar[int] = 1
    """Training views the method can do with."""
    splats: GaussianSet
    """What is shown and exported; made by `build`."""

    def __init__(self, config: Config):
        self.config: Config = config
        self.total_steps = config.steps

    def setup(
        self,
        views: Views,
        hooks: Sequence[GaussianHook],
        *,
        hull: Hull | None,
        device: torch.device,
        seed: int,
    ) -> None:
        if len(views) < self.fewest_views:
            raise SceneError(
                f"{type(self).__name__} compares training views, and there is {len(views)}",
                todo=f"give --views {self.fewest_views} or more",
            )
        self.device, self.seed, self.hooks, self.origin = device, seed, list(hooks), views.origin
        if device.type == "cpu":
            _load_kernels()
        self.unit = float(mean_distance(views.cameras.to("cpu", torch.float64))) or 1.0
        if self.config.colour_correction:
            self.correction = ColourCorrection(len(views), self.config.steps, device)
        self.virtual: VirtualViews | None = None
        if self.config.virtual_weight > 0 and hull is not None:
            self.virtual = VirtualViews(hull.inner or hull, views)
        self.build(views, hull, generator(seed, "initial_points"))
        refuse_unseen(self.splats.means, views, NEAR * self.unit)

    @abstractmethod
    def build(self, views: Views, hull: Hull | None, generator: Generator) -> None:
        """Makes the Gaussians and what changes their number; the generator draws where they start."""

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        return self.splats.draw(camera, background.to(self.device))

    def make_set(self, xyz: Tensor, rgb: Tensor, cameras: Cameras) -> GaussianSet:
        """Gaussians that start at points (N, 3) with colours (N, 3), for the training cameras (N,)."""
        extent = scene_extent(cameras)
        return GaussianSet(self.config, xyz, rgb, extent=extent, device=self.device, unit=self.unit)

    def summary(self) -> dict[str, int]:
        """What is shown of the model while it trains, and noted in run.json."""
        return {"gaussians": len(self.splats)}

    def export(self, folder: Path) -> list[Path]:
        path = Path(folder) / "point_cloud.ply"
        write_gaussians(path, self.splats.in_scene(), self.origin)
        return [path]


@cache
def _load_kernels() -> None:
    """Once in a process, which may set up many runs."""
    log.info("loading the CPU kernels")
    warm_up()


def refuse_unseen(means: Tensor, views: Views, near: float) -> None:
    """Sees to it that every training view with an object has a Gaussian to draw.

    Args:
        means: (N, 3) where the Gaussians start, in the cameras' frame.
        near: of the pictures, scene units.

    Raises:
        SceneError: a view that draws none.
    """
    for i, name in enumerate(views.names):
        camera = views.cameras[i].to("cpu", torch.float64)
        uv, depth = project(camera, means.cpu().double())
        size = torch.stack([camera.width, camera.height])
        near_picture = (uv > -SEEN_MARGIN * size) & (uv < (1 + SEEN_MARGIN) * size)
        if not bool(((depth > near) & near_picture.all(-1)).any()) and bool(views.demanded(i).any()):
            raise SceneError(
                f"nothing is drawn in training view {name}: none of the {len(means)} Gaussians lies before it",
                cause="a pose that looks away from the object, or points to start from that are in another frame",
                todo="look at the poses with visdom-check, or leave the view out with --train-list",
            )
