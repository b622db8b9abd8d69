"""ZeroRF (Shi et al. 2023) at a size for small captures: a factorised volume that networks make from noise."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Generator, Tensor, nn

from visdom_plugin.errors import VisDomError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.protocols import SamplerHook
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.fields.common import (
    MESH_RESOLUTION,
    FieldMesh,
    LocalRays,
    photograph_on,
    psnr_of,
    silhouette_loss,
)
from visdom_plugin.methods.fields.configs import ZeroRfConfig
from visdom_plugin.methods.fields.marched import MarchedField, points_of
from visdom_plugin.nerf.activations import density_of, padded_sigmoid
from visdom_plugin.nerf.encoding.factors import Factors, PlanesTimesLines, TwoVolumes
from visdom_plugin.nerf.encoding.view_directions import encode_harmonics
from visdom_plugin.nerf.frame import Frame, frame_of
from visdom_plugin.nerf.mlp import draw_weights
from visdom_plugin.nerf.optimiser import FieldOptimiser
from visdom_plugin.nerf.rendering.volume_packed import composite_packed
from visdom_plugin.nerf.sampling.occupancy_grid import OccupancyGrid, PackedSamples, select
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import PixelBatch, StepOutput

SATURATION = 0.001
"""How far colours reach beyond [0, 1], so that black and white need no infinite weights."""
FIT = VisibleDomain(resolution=96, components="largest")
"""What the cube is fitted to."""

log = logging.getLogger(__name__)


class Decoder(nn.Module):
    """Features of a point to its density, and with the viewing direction to its colour."""

    def __init__(self, features: int, hidden: int, views: int, generator: Generator):
        super().__init__()
        self.base, self.density = _linear(features, hidden, generator), _linear(hidden, 1, generator)
        self.views, self.colour = _linear(views, hidden, generator), _linear(hidden, 3, generator)
        nn.init.zeros_(self.views.weight)


class ZeroRfLite(MarchedField[ZeroRfConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    # A quarter of the other marched fields': features and hidden units of all samples are in memory at once.
    rays_at_once = 1 << 12

    def choose_frame(self, views: Views) -> Frame:
        return fit_cube(views, self.config.fit_margin)

    def build(self, cameras: Cameras, generator: Generator) -> None:
        c = self.config
        sizes = (c.noise_channels, c.noise_resolution, c.channels, c.width)
        factors: Factors
        if c.representation == "dif":
            factors = TwoVolumes(*sizes, c.dif_period, generator)
        else:
            factors = PlanesTimesLines(*sizes, generator)
        self.factors = factors.to(self.device)
        self.decoder = Decoder(factors.width, c.hidden, c.view_degree**2, generator).to(self.device)
        named = {f"factors.{k}": p for k, p in factors.named_parameters()}
        named |= {f"decoder.{k}": p for k, p in self.decoder.named_parameters()}
        self.optimiser = FieldOptimiser(
            [(named, c.weight_decay)], betas=c.betas, eps=1e-8, decoupled=True, clip=c.gradient_clip
        )
        self._made: list[Tensor] | None = None
        self.occupancy = OccupancyGrid(
            c.occupancy_resolution, c.half_side, c.occupancy_density, decay=0.9, device=self.device
        )
        if c.drop_unsampled:
            self.drop_unsampled(cameras)

    def pixels_per_step(self, step: int) -> int:
        """Pixels the batch of a step should have."""
        c = self.config
        first, second = c.rays_grow_at
        return (
            c.first_rays
            if step < first
            else c.rays
            if step >= second
            else round((c.first_rays * c.rays) ** 0.5)
        )

    def train_step(self, batch: PixelBatch, step: int) -> StepOutput:
        with self._make_once():
            return self._train_step(batch, step)

    def _train_step(self, batch: PixelBatch, step: int) -> StepOutput:
        c = self.config
        rgb, alpha, background, _ = self.draw(batch, step)
        error = rgb - photograph_on(background, batch, alpha)
        squares = error.square().sum(-1)
        if c.compare_alpha:
            wrong = alpha - batch.mask
            squares = squares + (wrong if batch.mask_known is None else wrong * batch.mask_known).square()
        losses = {"colour": c.mse_weight * squares.mean() / (4 if c.compare_alpha else 3)}
        if c.mask_weight:
            losses["mask"] = c.mask_weight * silhouette_loss(alpha, batch)
        losses |= self.prior_losses(step) | self.empty_losses(len(batch.mask), step)
        return StepOutput(losses, {"psnr": psnr_of(error)})

    def optimise(self, step: int, output: StepOutput) -> None:
        self.optimiser.step(self.config.lr)
        self.step_correction(step)

    def state_dict(self) -> dict[str, Tensor]:
        return super().state_dict() | {f"factors.{k}": v for k, v in self.factors.named_buffers()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state)
        for name, noise in self.factors.named_buffers():
            noise.copy_(state[f"factors.{name}"])

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        with self._make_once():
            return super().render(camera, background)

    def mesh(self, resolution: int = MESH_RESOLUTION) -> FieldMesh | None:
        """The surface in the capture's frame; see `mesh_density`."""
        with torch.no_grad(), self._make_once():
            return super().mesh(resolution)

    def occupancy_of_renders(self) -> OccupancyGrid:
        return self.occupancy.loosened(self.config.test_occupancy_density)

    def _take_samples(
        self,
        rays: LocalRays,
        far: Tensor,
        step_length: Tensor,
        shift: Tensor,
        hooks: Sequence[SamplerHook],
        grid: OccupancyGrid,
    ) -> PackedSamples:
        samples = super()._take_samples(rays, far, step_length, shift, hooks, grid)
        if not self.config.cull_weight or not torch.is_grad_enabled():
            return samples
        with torch.no_grad():
            density = self.density(points_of(rays, samples))
            black = density.new_zeros(len(far), 3)
            intervals = samples.starts, samples.ends, samples.ray_offsets
            *_, weights = composite_packed(density, density[:, None].expand(-1, 3), *intervals, black)
        return select(samples, weights > self.config.cull_weight)

    def _features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        with self._make_once() as made:
            base = self.decoder.base(self.factors.look_up(points, made))
        out = self.decoder.density(nn.functional.silu(base))
        return density_of(out, self.config.density_bias)[0], base

    def _encode_views(self, directions: Tensor) -> Tensor:
        return self.decoder.views(encode_harmonics(directions)[..., : self.config.view_degree**2])

    def _look(self, features: Tensor, views: Tensor) -> Tensor:
        return padded_sigmoid(self.decoder.colour(nn.functional.silu(features + views)), SATURATION)

    @contextmanager
    def _make_once(self) -> Iterator[list[Tensor]]:
        """Within, the networks make planes, lines or volumes once, however often points are looked up."""
        outer = self._made
        made = self._made = self.factors.make() if outer is None else outer
        try:
            yield made
        finally:
            self._made = outer


def fit_cube(views: Views, margin: float) -> Frame:
    """The frame in which the object fills the cube [-1, 1]^3, from the training views' silhouettes alone.

    Args:
        margin: room around the object, as a share of its half side.
    """
    fit = replace(FIT, k=min(3, len(views)))
    try:
        low, high = (torch.as_tensor(x) for x in fit.carve(*views.silhouettes()).extent)
    except VisDomError as error:
        frame = frame_of(views.cameras)
        log.warning(
            "the cube is not fitted to the object, but reaches half way to the cameras: %s", error.what
        )
        return frame._replace(scale=2 * frame.scale)
    return Frame((low + high) / 2, float(2 / ((1 + margin) * (high - low).max())))


def _linear(inputs: int, outputs: int, generator: Generator) -> nn.Linear:
    """Weights uniform within +-sqrt(6 / (inputs + outputs)) (Glorot and Bengio 2010), biases zero."""
    layer = nn.Linear(inputs, outputs)
    draw_weights(layer, math.sqrt(6 / (inputs + outputs)), generator)
    return layer
