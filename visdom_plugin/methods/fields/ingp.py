"""Instant-NGP (Müller et al. 2022): a hash grid, two small networks and an occupancy grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.protocols import SamplerHook, sample_filters
from visdom_plugin.losses import mask_loss
from visdom_plugin.methods.fields.common import (
    MESH_RESOLUTION,
    FieldMesh,
    LocalRays,
    export_mesh,
    mesh_density,
    photograph_on,
    psnr_of,
    silhouette_loss,
    spread_rays,
)
from visdom_plugin.methods.fields.configs import IngpConfig
from visdom_plugin.methods.fields.radiance_field import RadianceField
from visdom_plugin.nerf.encoding.hash_grid import encode, initial_table
from visdom_plugin.nerf.encoding.view_directions import encode_harmonics
from visdom_plugin.nerf.mlp import perceptron, truncated_exp
from visdom_plugin.nerf.optimiser import FieldOptimiser, warm_up_and_steps
from visdom_plugin.nerf.rendering.volume_packed import composite_packed
from visdom_plugin.nerf.sampling.occupancy_grid import (
    OccupancyGrid,
    PackedSamples,
    intersect_cube,
    march_occupied,
    select,
)
from visdom_plugin.seeding import draw_on, generator, uniform
from visdom_plugin.training.protocols import PixelBatch, StepOutput

HUBER_DELTA = 0.1  # Instant-NGP
LEAST_RAYS = 64


class Ingp(RadianceField[IngpConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    rays_at_once = 1 << 14

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
            # VaxNeRF's novel views do look at what training leaves out, so the grid must not hide it.
            hooks = [] if c.vd.drop_outside else self.hooks
            parts = [self.bound(*spread_rays(cameras[i]), hooks) for i in range(len(cameras))]
            rays = LocalRays(*(torch.cat(x) for x in zip(*parts, strict=True)))
            self.occupancy.restrict(rays.origins, rays.directions, rays.near, rays.far)

    def pixels_per_step(self, step: int) -> int:
        """Pixels the next batch should have."""
        return self._rays

    def train_step(self, batch: PixelBatch, step: int) -> StepOutput:
        c = self.config
        draw = draw_on(self.device, generator(self.seed, "step", step))
        if step % c.occupancy_every == 0:
            fraction = 1.0 if step < c.occupancy_warm_up else c.occupancy_fraction
            self.occupancy.update(self.density, generator(self.seed, "occupancy", step), fraction=fraction)
        n = len(batch.mask)
        background = self.draw_background(n, draw)
        rays = self.bound(batch.origins, batch.directions, self.hooks, batch.pixels)
        step_length = torch.where(rays.hit, c.step_length, c.missing_step_length)
        shift = uniform(draw, self.device, n)
        samples = self._take_samples(rays, rays.far, step_length, shift, self.hooks)
        rgb, alpha, _ = self._shade(rays, samples, background)
        rgb = self.correct(rgb, alpha, background, batch.pixels)
        target = photograph_on(background, batch, alpha)
        self._adapt(n, len(samples.ray))
        losses = {"colour": torch.nn.functional.huber_loss(rgb, target, delta=HUBER_DELTA) / HUBER_DELTA}
        if c.mask_weight:
            losses["mask"] = c.mask_weight * silhouette_loss(alpha, batch)
        losses |= self.prior_losses(step) | self.empty_losses(n, step)
        return StepOutput(losses, {"psnr": psnr_of(rgb - target)})

    def silhouette_of_nothing(
        self, rays: LocalRays, radius: Tensor, step: int, generator: Generator
    ) -> Tensor:
        step_length = torch.full_like(rays.far, self.config.missing_step_length)
        shift = uniform(generator, self.device, len(rays.far))
        samples = self._take_samples(rays, rays.far, step_length, shift, [])
        alpha = self._shade(rays, samples, rays.origins.new_ones(len(rays.far), 3))[1]
        return mask_loss(alpha, torch.zeros_like(alpha))

    def optimise(self, step: int, output: StepOutput) -> None:
        c = self.config
        lr = warm_up_and_steps(
            step, c.steps, base=c.lr, warm_up=c.lr_warm_up, factor=c.lr_factor, at=(0.5, 0.75, 0.9)
        )
        self.optimiser.step(lr)
        self.step_correction(step)

    def render_rays(
        self, origins: Tensor, directions: Tensor, radius: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        hooks = self.hooks_at_inference()
        rays = self.bound(origins, directions, hooks)
        far = torch.where(rays.hit, rays.far, rays.near)
        step_length = torch.full_like(far, self.config.step_length)
        samples = self._take_samples(rays, far, step_length, torch.zeros_like(far), hooks)
        return self._shade(rays, samples, background.expand(len(far), 3))

    def state_dict(self) -> dict[str, Tensor]:
        occupancy = {f"occupancy.{k}": v for k, v in self.occupancy.state_dict().items()}
        return super().state_dict() | occupancy | {"rays": torch.tensor(self._rays)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state)
        prefix = "occupancy."
        self.occupancy.load_state_dict(
            {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
        )
        self._rays = int(state["rays"])

    def export(self, folder: Path) -> list[Path]:
        return export_mesh(Path(folder) / "mesh.ply", self.mesh())

    def mesh(self, resolution: int = MESH_RESOLUTION) -> FieldMesh | None:
        """The surface in the capture's frame; see `mesh_density`."""

        def density_of(points: Tensor) -> Tensor:
            # What rendering skips is not there.
            points = points.to(self.device)
            there = self.occupancy.is_occupied(points)
            for hook in sample_filters(self.hooks_at_inference()):
                there &= hook.keep(self.frame.to_world(points))
            return torch.where(there, self.density(points), 0)

        half_side = self.config.half_side
        return mesh_density(
            density_of, self._colour, self.frame, half_side, resolution=resolution, origin=self.origin
        )

    def own_bounds(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        enter, leave = intersect_cube(self.frame.to_local(origins), directions.float(), self.config.half_side)
        near = enter.clamp_min(self.config.near)
        return near, torch.maximum(leave, near)

    def _take_samples(
        self, rays: LocalRays, far: Tensor, step_length: Tensor, shift: Tensor, hooks: Sequence[SamplerHook]
    ) -> PackedSamples:
        samples = march_occupied(
            rays.origins, rays.directions, rays.near, far, step_length, shift, self.occupancy
        )
        for hook in sample_filters(hooks):
            samples = select(samples, hook.keep(self.frame.to_world(_points(rays, samples))))
        return samples

    def _features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        c = self.config
        unit = points * (0.5 / c.half_side) + 0.5
        out = self.density_net(encode(unit, self.table, c.grid))
        return truncated_exp(out[:, 0] + c.density_bias), out[:, 1:]

    def density(self, points: Tensor) -> Tensor:
        return self._features(points.to(self.device))[0]

    def _colour(self, points: Tensor, directions: Tensor) -> Tensor:
        _, features = self._features(points.to(self.device))
        return self._look(features, directions.to(self.device))

    def _look(self, features: Tensor, directions: Tensor) -> Tensor:
        return self.colour_net(torch.cat([features, self._encode_views(directions)], -1)).sigmoid()

    def _encode_views(self, directions: Tensor) -> Tensor:
        return encode_harmonics(directions)[..., : self.config.view_degree**2]

    def _shade(
        self, rays: LocalRays, samples: PackedSamples, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        density, features = self._features(_points(rays, samples))
        # Harmonics once per ray, then spread to its samples.
        views = self._encode_views(rays.directions)[samples.ray]
        colours = self.colour_net(torch.cat([features, views], -1)).sigmoid()
        rgb, alpha, depth, _ = composite_packed(
            density, colours, samples.starts, samples.ends, samples.ray_offsets, background
        )
        return rgb, alpha, depth

    def _adapt(self, rays: int, samples: int) -> None:
        wanted = int(rays * self.config.samples_per_step / max(samples, 1))
        # At most doubled: right after the first cullings rays may carry no sample at all.
        self._rays = max(LEAST_RAYS, min(wanted, 2 * rays, self.config.max_rays))


def _points(rays: LocalRays, samples: PackedSamples) -> Tensor:
    """(M, 3) where the field is asked: the middles of the intervals, in the field's frame."""
    middles = (samples.starts + samples.ends) / 2
    return rays.origins[samples.ray] + middles[:, None] * rays.directions[samples.ray]
