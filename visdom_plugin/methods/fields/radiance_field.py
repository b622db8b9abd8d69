"""Base of the radiance fields: where they live, what they are handed, and how a view is drawn ray by ray."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras, pixel_radius
from visdom_plugin.hooks.protocols import PixelSampler, SamplerHook, empty_spaces
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.colour_correction import ColourCorrection, CorrectsColours
from visdom_plugin.methods.fields.common import (
    MOST_PIXELS,
    LocalRays,
    PixelBounds,
    bound_rays,
    render_image,
    spread_rays,
)
from visdom_plugin.methods.fields.configs import IngpConfig, ZeroRfConfig, ZipNerfConfig
from visdom_plugin.methods.fields.shape_prior import ShapePrior
from visdom_plugin.nerf.frame import Frame, frame_of
from visdom_plugin.nerf.optimiser import FieldOptimiser
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.seeding import draw_on, generator, uniform
from visdom_plugin.training.protocols import PixelBatch, StepOutput

Config = TypeVar("Config", IngpConfig, ZeroRfConfig, ZipNerfConfig)

log = logging.getLogger(__name__)


class RadianceField(CorrectsColours, ABC, Generic[Config]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    rays_at_once: ClassVar[int]
    """When rendering."""
    optimiser: FieldOptimiser
    """Of all that is trained; made by `build`."""

    def __init__(self, config: Config):
        self.config: Config = config
        self.total_steps = config.steps

    def setup(
        self,
        views: Views,
        hooks: Sequence[SamplerHook],
        *,
        hull: Hull | None,
        device: torch.device,
        seed: int,
    ) -> None:
        self.device, self.seed, self.hooks, self.origin = device, seed, list(hooks), views.origin
        self.frame = self.choose_frame(views)
        if len(views) <= self.config.few_views and self.config.few_views_share < 1:
            self.total_steps = max(1, round(self.config.few_views_share * self.config.steps))
        cameras = views.cameras.to(device)
        self._follow_pixels(cameras)
        self.prior: ShapePrior | None = None
        if self.config.prior_weight > 0 and hull is not None and hull.inner is not None:
            self.prior = ShapePrior(hull, self.frame)
        if self.config.colour_correction:
            self.correction = ColourCorrection(len(views), self.config.steps, device)
            self._last_pixels = (views.cameras.width * views.cameras.height).cumsum(0).to(device)
        self.build(cameras, generator(seed, "field"))
        if device.type == "cpu":
            self._warm_up(views.cameras[0])

    def choose_frame(self, views: Views) -> Frame:
        """Where the field lives, from the training views."""
        return frame_of(views.cameras)

    @abstractmethod
    def build(self, cameras: Cameras, generator: Generator) -> None:
        """Makes parameters and optimiser, for the training cameras (N,) on the method's device."""

    @abstractmethod
    def own_bounds(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Near and far (n,) of rays in the world frame without hooks, in the field's frame."""

    @abstractmethod
    def train_step(self, batch: PixelBatch, step: int) -> StepOutput: ...

    @abstractmethod
    def render_rays(
        self, origins: Tensor, directions: Tensor, radius: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What `render_image` asks for; `radius` of the pixels' cones at distance 1."""

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        background, radius = background.to(self.device), pixel_radius(camera)
        return render_image(
            camera.to(self.device),
            lambda origins, directions: self.render_rays(origins, directions, radius, background),
            self.frame,
            self.rays_at_once,
        )

    def _follow_pixels(self, cameras: Cameras) -> None:
        """Prepares for questions about the pixels of the training cameras (N,), whose rays never change."""
        self._kept: PixelBounds | None = None
        pixels = int((cameras.width * cameras.height).sum())
        samplers = [hook for hook in self.hooks if isinstance(hook, PixelSampler)]
        if len(samplers) == len(self.hooks) and pixels <= MOST_PIXELS:
            self._kept = PixelBounds(cameras, lambda o, d: self.bound(o, d, self.hooks))
            return
        for hook in samplers:
            hook.follow_pixels(cameras)

    def training_rays(self, batch: PixelBatch) -> LocalRays:
        """The rays of a batch, bounded by the hooks."""
        if batch.pixels is None or self._kept is None:
            return self.bound(batch.origins, batch.directions, self.hooks, batch.pixels)
        origins = self.frame.to_local(batch.origins)
        return LocalRays(origins, batch.directions.float(), *self._kept.of(batch.pixels))

    def bound(
        self,
        origins: Tensor,
        directions: Tensor,
        hooks: Sequence[SamplerHook],
        pixels: Tensor | None = None,
    ) -> LocalRays:
        """See `bound_rays`."""
        near, far = self.own_bounds(origins, directions)
        return bound_rays(origins, directions, near, far, self.frame, hooks, pixels)

    def hooks_at_inference(self) -> list[SamplerHook]:
        """The hooks that bound the rays of novel views."""
        return self.hooks if self.config.vd.hull_at_inference else []

    @abstractmethod
    def density(self, points: Tensor) -> Tensor:
        """Density (m,) per unit of the field's frame at points (m, 3) in that frame, on any device."""

    def prior_losses(self, step: int) -> dict[str, Tensor]:
        """The loss that the shape inside the hull adds, by name; none where it is not asked for."""
        if self.prior is None:
            return {}
        loss = self.prior.loss(self.density, generator(self.seed, "prior", step))
        return {"prior": self.config.prior_weight * loss}

    @abstractmethod
    def silhouette_of_nothing(
        self, rays: LocalRays, radius: Tensor, step: int, generator: Generator
    ) -> Tensor:
        """The silhouette loss along rays whose mask is 0, a scalar; unweighted.

        Args:
            radius: (n,) of the pixels' cones at distance 1.
            generator: on the method's device, draws where samples lie.
        """

    def empty_losses(self, photographed: int, step: int) -> dict[str, Tensor]:
        """The loss that hooks ask for along rays of empty space, by name; none where they ask for none.

        Args:
            photographed: rays of photographs in the step.
        """
        losses = []
        for i, hook in enumerate(empty_spaces(self.hooks)):
            draw = generator(self.seed, "empty", i, step)
            empty = hook.empty_rays(photographed, draw, self.device)
            if len(empty.origins):
                rays = self.bound(empty.origins, empty.directions, [])
                loss = self.silhouette_of_nothing(rays, empty.radii, step, draw_on(self.device, draw))
                losses.append(hook.virtual_weight * loss)
        return {"empty": sum(losses[1:], losses[0])} if losses else {}

    def correct(self, rgb: Tensor, alpha: Tensor, background: Tensor, pixels: Tensor | None) -> Tensor:
        """Colours (n, 3) of training pixels as their photographs' camera took them; see `ColourCorrection`."""
        if self.correction is None or pixels is None:
            return rgb
        view = torch.searchsorted(self._last_pixels, pixels, right=True)
        return self.correction.apply(rgb, alpha, background, view)

    def draw_background(self, n: int, generator: Generator) -> Tensor:
        """(n, 3) behind the photographs of a training step."""
        if self.config.background == "random":
            return uniform(generator, self.device, n, 3)
        return torch.ones(n, 3, device=self.device)

    def state_dict(self) -> dict[str, Tensor]:
        return self.optimiser.state_dict() | self.correction_state()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.optimiser.load_state_dict(state)
        self.load_correction(state)

    def _warm_up(self, camera: Cameras) -> None:
        """Compiles the CPU kernels of a step, or loads them, on 16 pixels; the gradients are dropped."""
        log.info("loading the CPU kernels")
        origins, directions = (x.float() for x in spread_rays(camera, 4))
        n = len(origins)
        batch = PixelBatch(
            origins=origins,
            directions=directions,
            rgb=torch.rand(n, 3, generator=torch.Generator().manual_seed(0)),
            mask=torch.ones(n),
            radii=pixel_radius(camera).expand(n),
        )
        self.train_step(batch, 1).total.backward()
        self.optimiser.drop_gradients()
