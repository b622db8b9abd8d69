"""Instant-NGP (Müller et al. 2022): a hash grid, two small networks and an occupancy grid."""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.methods.fields.common import LocalRays, photographed
from visdom_plugin.methods.fields.configs import IngpConfig
from visdom_plugin.methods.fields.marched import MarchedField
from visdom_plugin.nerf.activations import density_of, padded_sigmoid
from visdom_plugin.nerf.encoding.hash_grid import encode, initial_table
from visdom_plugin.nerf.encoding.view_directions import encode_harmonics
from visdom_plugin.nerf.mlp import perceptron
from visdom_plugin.nerf.optimiser import FieldOptimiser, warm_up_and_steps
from visdom_plugin.nerf.rendering.ngp_shading import NgpField, shade
from visdom_plugin.nerf.rendering.ray_losses import ray_losses
from visdom_plugin.nerf.sampling.occupancy_grid import OccupancyGrid, PackedSamples
from visdom_plugin.training.protocols import PixelBatch, StepOutput

HUBER_DELTA = 0.1  # Instant-NGP
LEAST_RAYS = 64


class Ingp(MarchedField[IngpConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    def build(self, cameras: Cameras, generator: Generator) -> None:
        c, self._rays = self.config, LEAST_RAYS
        self.table = torch.nn.Parameter(initial_table(c.grid, generator).to(self.device))
        self.density_net = perceptron([c.grid.width, c.hidden, 1 + c.geometry_features], generator).to(
            self.device
        )
        self.colour_net = perceptron(
            [c.view_degree**2 + c.geometry_features, c.hidden, c.hidden, 3], generator
        ).to(self.device)
        nets = {f"density_net.{k}": p for k, p in self.density_net.named_parameters()}
        nets |= {f"colour_net.{k}": p for k, p in self.colour_net.named_parameters()}
        self.optimiser = FieldOptimiser(
            [({"table": self.table}, 0.0), (nets, c.weight_decay)], betas=(0.9, 0.99), eps=1e-15
        )
        self.occupancy = OccupancyGrid(
            c.occupancy_resolution, c.half_side, c.occupancy_alpha / c.step_length, device=self.device
        )
        if c.drop_unsampled:
            self.drop_unsampled(cameras)

    def pixels_per_step(self, step: int) -> int:
        """Pixels the next batch should have."""
        return self._rays

    def train_step(self, batch: PixelBatch, step: int) -> StepOutput:
        c, n = self.config, len(batch.mask)
        rgb, alpha, background, samples = self.draw(batch, step)
        self._adapt(n, samples)
        found = ray_losses(rgb, alpha, photographed(batch), background, HUBER_DELTA, c.mask_weight)
        losses = {"colour": found.colour}
        if c.mask_weight:
            losses["mask"] = found.mask
        losses |= self.prior_losses(step) | self.empty_losses(n, step)
        return StepOutput(losses, {"psnr": found.psnr})

    def optimise(self, step: int, output: StepOutput) -> None:
        c = self.config
        lr = warm_up_and_steps(
            step, c.steps, base=c.lr, warm_up=c.lr_warm_up, factor=c.lr_factor, at=(0.5, 0.75, 0.9)
        )
        self.optimiser.step(lr)
        self.step_correction(step)

    def state_dict(self) -> dict[str, Tensor]:
        return super().state_dict() | {"rays": torch.tensor(self._rays)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state)
        self._rays = int(state["rays"])

    def _features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density (m,), and the density network's outputs (m, 1 + geometry_features)."""
        c = self.config
        unit = points * (0.5 / c.half_side) + 0.5
        return density_of(self.density_net(encode(unit, self.table, c.grid)), c.density_bias)

    def _encode_views(self, directions: Tensor) -> Tensor:
        return encode_harmonics(directions)[..., : self.config.view_degree**2]

    def _look(self, features: Tensor, views: Tensor) -> Tensor:
        return padded_sigmoid(self.colour_net(features, views, lead=1))

    def _shade(
        self, rays: LocalRays, samples: PackedSamples, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        field = NgpField(
            self.config.grid,
            self.table,
            self.density_net,
            self.colour_net,
            self.config.half_side,
            self.config.density_bias,
        )
        # Whoever changes a part of the field, as a subclass does, gets its parts one after the other.
        changed = self._features != Ingp._features.__get__(self) or self._look != Ingp._look.__get__(self)
        if changed or not field.has_kernels():
            return super()._shade(rays, samples, background)
        return shade(field, rays.origins, rays.directions, samples, background)

    def _adapt(self, rays: int, samples: int) -> None:
        wanted = int(rays * self.config.samples_per_step / max(samples, 1))
        # At most doubled: right after the first cullings rays may carry no sample at all.
        self._rays = max(LEAST_RAYS, min(wanted, 2 * rays, self.config.max_rays))
