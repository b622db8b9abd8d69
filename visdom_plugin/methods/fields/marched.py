"""Base of the radiance fields that march through an occupancy grid: what they draw, keep and export alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

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
    spread_rays,
)
from visdom_plugin.methods.fields.configs import IngpConfig, ZeroRfConfig
from visdom_plugin.methods.fields.radiance_field import RadianceField
from visdom_plugin.nerf.rendering.volume_packed import composite_packed
from visdom_plugin.nerf.sampling.occupancy_grid import (
    OccupancyGrid,
    PackedSamples,
    intersect_cube,
    march_occupied,
    middles_of,
    select,
)
from visdom_plugin.seeding import draw_on, generator, uniform
from visdom_plugin.training.protocols import PixelBatch

Config = TypeVar("Config", IngpConfig, ZeroRfConfig)


class Drawn(NamedTuple):
    """A batch of training pixels as the field shows them."""

    rgb: Tensor
    """(n, 3) over the background."""
    alpha: Tensor
    """(n,)."""
    background: Tensor
    """(n, 3)."""
    samples: int
    """Along all rays."""


class MarchedField(RadianceField[Config]):
    """A field in the cube of half side `config.half_side`, sampled where its occupancy grid sees any density."""

    rays_at_once = 1 << 14
    occupancy: OccupancyGrid
    """Made by `build`."""

    @abstractmethod
    def _features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density (m,) at points (m, 3) on the method's device, and what `_look` makes colours of, (m, ...)."""

    @abstractmethod
    def _encode_views(self, directions: Tensor) -> Tensor:
        """Unit viewing directions (n, 3) as `_look` takes them, (n, ...)."""

    @abstractmethod
    def _look(self, features: Tensor, views: Tensor) -> Tensor:
        """Colours (m, 3) from features and encoded viewing directions."""

    def drop_unsampled(self, cameras: Cameras) -> None:
        """Empties the cells that no ray of the training cameras samples, for ever."""
        # VaxNeRF's novel views do look at what training leaves out, so the grid must not hide it.
        hooks = [] if self.config.vd.drop_outside else self.hooks
        parts = [self.bound(*spread_rays(cameras[i]), hooks) for i in range(len(cameras))]
        rays = LocalRays(*(torch.cat(x) for x in zip(*parts, strict=True)))
        self.occupancy.restrict(rays.origins, rays.directions, rays.near, rays.far)

    def draw(self, batch: PixelBatch, step: int) -> Drawn:
        """The pixels of a training step; now and then the occupancy grid is brought up to date before."""
        c = self.config
        draw = draw_on(self.device, generator(self.seed, "step", step))
        if step % c.occupancy_every == 0:
            fraction = 1.0 if step < c.occupancy_warm_up else c.occupancy_fraction
            self.occupancy.update(self.density, generator(self.seed, "occupancy", step), fraction=fraction)
        n = len(batch.mask)
        background = self.draw_background(n, draw)
        rays = self.training_rays(batch)
        step_length = torch.where(rays.hit, c.step_length, c.missing_step_length)
        shift = uniform(draw, self.device, n)
        samples = self._take_samples(rays, rays.far, step_length, shift, self.hooks, self.occupancy)
        rgb, alpha, _ = self._shade(rays, samples, background)
        rgb = self.correct(rgb, alpha, background, batch.pixels)
        return Drawn(rgb, alpha, background, len(samples.ray))

    def silhouette_of_nothing(
        self, rays: LocalRays, radius: Tensor, step: int, generator: Generator
    ) -> Tensor:
        step_length = torch.full_like(rays.far, self.config.missing_step_length)
        shift = uniform(generator, self.device, len(rays.far))
        samples = self._take_samples(rays, rays.far, step_length, shift, [], self.occupancy)
        alpha = self._shade(rays, samples, rays.origins.new_ones(len(rays.far), 3))[1]
        return mask_loss(alpha, torch.zeros_like(alpha))

    def render_rays(
        self, origins: Tensor, directions: Tensor, radius: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        hooks = self.hooks_at_inference()
        rays = self.bound(origins, directions, hooks)
        far = torch.where(rays.hit, rays.far, rays.near)
        step_length = torch.full_like(far, self.config.step_length)
        grid = self.occupancy_of_renders()
        samples = self._take_samples(rays, far, step_length, torch.zeros_like(far), hooks, grid)
        return self._shade(rays, samples, background.expand(len(far), 3))

    def state_dict(self) -> dict[str, Tensor]:
        occupancy = {f"occupancy.{k}": v for k, v in self.occupancy.state_dict().items()}
        return super().state_dict() | occupancy

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state)
        prefix = "occupancy."
        self.occupancy.load_state_dict(
            {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
        )

    def export(self, folder: Path) -> list[Path]:
        return export_mesh(Path(folder) / "mesh.ply", self.mesh())

    def mesh(self, resolution: int = MESH_RESOLUTION) -> FieldMesh | None:
        """The surface in the capture's frame; see `mesh_density`."""

        grid = self.occupancy_of_renders()

        def density_of(points: Tensor) -> Tensor:
            # What rendering skips is not there.
            points = points.to(self.device)
            there = grid.is_occupied(points)
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

    def density(self, points: Tensor) -> Tensor:
        return self._features(points.to(self.device))[0]

    def _colour(self, points: Tensor, directions: Tensor) -> Tensor:
        _, features = self._features(points.to(self.device))
        return self._look(features, self._encode_views(directions.to(self.device)))

    def occupancy_of_renders(self) -> OccupancyGrid:
        """The grid through which novel views are marched, and outside of which the mesh has nothing."""
        return self.occupancy

    def _take_samples(
        self,
        rays: LocalRays,
        far: Tensor,
        step_length: Tensor,
        shift: Tensor,
        hooks: Sequence[SamplerHook],
        grid: OccupancyGrid,
    ) -> PackedSamples:
        samples = march_occupied(rays.origins, rays.directions, rays.near, far, step_length, shift, grid)
        for hook in sample_filters(hooks):
            samples = select(samples, hook.keep(self.frame.to_world(points_of(rays, samples))))
        return samples

    def _shade(
        self, rays: LocalRays, samples: PackedSamples, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        density, features = self._features(points_of(rays, samples))
        # Directions once per ray, then spread to its samples. Not by [samples.ray], whose gradients are summed in
        # whatever order the threads come.
        views = self._encode_views(rays.directions).index_select(0, samples.ray)
        colours = self._look(features, views)
        rgb, alpha, depth, _ = composite_packed(
            density, colours, samples.starts, samples.ends, samples.ray_offsets, background
        )
        return rgb, alpha, depth


def points_of(rays: LocalRays, samples: PackedSamples) -> Tensor:
    """(M, 3) where the field is asked: the middles of the intervals, in the field's frame."""
    return middles_of(rays.origins, rays.directions, samples)
