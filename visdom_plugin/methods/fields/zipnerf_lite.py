"""Zip-NeRF (Barron et al. 2023) at a size for small captures: two proposals and a field, all anti-aliased."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.losses import mask_loss
from visdom_plugin.methods.fields.common import (
    MESH_RESOLUTION,
    FieldMesh,
    LocalRays,
    export_mesh,
    mesh_density,
    photograph_on,
    psnr_of,
)
from visdom_plugin.methods.fields.configs import ZipNerfConfig
from visdom_plugin.methods.fields.radiance_field import RadianceField
from visdom_plugin.nerf.activations import density_of, padded_sigmoid
from visdom_plugin.nerf.encoding.hash_grid import (
    HashLayout,
    encode_spread,
    initial_table,
    mean_square_per_level,
)
from visdom_plugin.nerf.encoding.view_directions import encode_sinusoids
from visdom_plugin.nerf.mlp import perceptron, run_layers
from visdom_plugin.nerf.optimiser import FieldOptimiser, warm_up_and_decay
from visdom_plugin.nerf.rendering.proposal_losses import antialiased_interlevel_loss, distortion_loss
from visdom_plugin.nerf.rendering.volume import composite, weights_from_density
from visdom_plugin.nerf.sampling.contraction import contract
from visdom_plugin.nerf.sampling.multisampling import multisample
from visdom_plugin.nerf.sampling.ray_warp import curve_distances
from visdom_plugin.nerf.sampling.step_functions import anneal_exponent, sample_distances
from visdom_plugin.render import Render
from visdom_plugin.seeding import draw_on, generator, uniform
from visdom_plugin.training.protocols import PixelBatch, StepOutput

CHARBONNIER = 0.001  # Zip-NeRF
RGB_PADDING = 0.001  # mip-NeRF
INITIAL_FEATURE = 1e-4
LEVELS = ("coarse", "fine", "field")
INVISIBLE = 1 / 255
"""Opacity of a whole ray: one step of an 8-bit image."""


class AntialiasedGrid(nn.Module):
    """A hash grid over contracted space, and one hidden layer behind it. The first output is the density's."""

    def __init__(self, layout: HashLayout, hidden: int, outputs: int, generator: Generator):
        super().__init__()
        self.layout = layout
        self.table = nn.Parameter(initial_table(layout, generator, INITIAL_FEATURE))
        # Features, and for each level how much of it the sample is too large for.
        self.net = perceptron([layout.width + layout.levels, hidden, outputs], generator)

    def forward(
        self, points: Tensor, std: Tensor, mean_squares: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """(..., S, 3) points in the local frame and (..., S) standard deviations to (..., outputs), and the mean
        squares (levels,) with their gradient. `mean_squares` saves looking through the table for them.
        """
        unit, std = contract(points, std, scale=0.25, shift=0.5)
        squares = self.mean_squares() if mean_squares is None else mean_squares
        features, left_out, squares = encode_spread(
            unit, std, self.table, self.layout, squares, INITIAL_FEATURE
        )
        return self.net(features, left_out), squares

    def mean_squares(self) -> Tensor:
        """(levels,) of the table's features, without gradient."""
        return mean_square_per_level(self.table.detach(), self.layout)


class ColourNet(nn.Module):
    """Hidden layers whose input joins again before the last of them."""

    def __init__(self, inputs: int, hidden: int, layers: int, generator: Generator):
        super().__init__()
        self.layers = nn.ModuleList()
        width = inputs
        for i in range(layers):
            if i and i + 1 == layers:
                width += inputs
            self.layers.append(perceptron([width, hidden, hidden], generator, bias=True)[0])
            width = hidden
        self.last = perceptron([width, 3], generator, bias=True)

    def forward(self, seen: Tensor, views: Tensor) -> Tensor:
        """Colours (..., 3) of a density network's outputs (..., 1 + bottleneck), the first of which is left out,
        and of encoded directions (..., v), one for several points in a row."""
        linears = [*self.layers, self.last[0]]
        again = len(self.layers) - 1
        rgb = run_layers(linears, seen, views, lead=1, again=again if again else None)
        return padded_sigmoid(rgb, RGB_PADDING)


class Level(NamedTuple):
    """What one level sees along rays."""

    s: Tensor
    """(n, S + 1) normalised edges."""
    t: Tensor
    """(n, S + 1) edges in the local frame."""
    weights: Tensor
    """(n, S)."""


class ZipNerfLite(RadianceField[ZipNerfConfig]):
    """See `visdom_plugin.training.protocols.Method` for what each call does."""

    rays_at_once = 1 << 12

    def build(self, cameras: Cameras, generator: Generator) -> None:
        c = self.config
        self.model = nn.ModuleDict(
            {
                "coarse": AntialiasedGrid(c.coarse_grid, c.hidden, 1, generator),
                "fine": AntialiasedGrid(c.fine_grid, c.hidden, 1, generator),
                "field": AntialiasedGrid(c.grid, c.hidden, 1 + c.bottleneck, generator),
                "colour": ColourNet(
                    c.bottleneck + 3 + 6 * c.view_degree, c.colour_hidden, c.colour_layers, generator
                ),
            }
        ).to(self.device)
        self._squares: list[Tensor] | None = None
        named = dict(self.model.named_parameters())
        self.optimiser = FieldOptimiser([(named, 0.0)], betas=(0.9, 0.99), eps=1e-15)

    def pixels_per_step(self, step: int) -> int:
        return self.config.rays

    def train_step(self, batch: PixelBatch, step: int) -> StepOutput:
        c = self.config
        draw = draw_on(self.device, generator(self.seed, "step", step))
        background = self.draw_background(len(batch.mask), draw)
        rays = self.training_rays(batch)
        levels, out, squares = self._see(rays, batch.radii, c.samples, step, draw)
        colours = self._shade(out, rays.directions[:, None])
        last = levels[-1]
        rgb, alpha, _ = composite(last.weights, colours, last.t, background)
        rgb = self.correct(rgb, alpha, background, batch.pixels)
        target = photograph_on(background, batch, alpha)
        error = rgb - target
        losses = {"colour": (error.square() + CHARBONNIER**2).sqrt().mean()}
        if c.mask_weight:
            known = None if batch.mask_known is None else batch.mask_known.float()
            losses["mask"] = c.mask_weight * self._silhouette_loss(levels, alpha, batch.mask, known)
        if c.interlevel_weight:
            proposals = (
                antialiased_interlevel_loss(
                    last.s, last.weights.detach(), level.s, level.weights, width
                ).mean()
                / level.weights.shape[-1]
                for level, width in zip(levels[:-1], c.blur, strict=True)
            )
            losses["interlevel"] = c.interlevel_weight * reduce(torch.add, proposals)
        if c.distortion_weight:
            loss = distortion_loss(curve_distances(last.t), last.weights).mean()
            losses["distortion"] = c.distortion_weight * loss
        if c.hash_decay:
            losses["hash_decay"] = c.hash_decay * torch.cat(squares).sum()
        losses |= self.prior_losses(step) | self.empty_losses(len(batch.mask), step)
        return StepOutput(losses, {"psnr": psnr_of(error)})

    def silhouette_of_nothing(
        self, rays: LocalRays, radius: Tensor, step: int, generator: Generator
    ) -> Tensor:
        levels, _, _ = self._see(rays, radius, self.config.samples, step, generator)
        return self._silhouette_loss(levels, levels[-1].weights.sum(-1), torch.zeros_like(radius))

    def _silhouette_loss(
        self, levels: list[Level], alpha: Tensor, mask: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """Of the field, whose opacity is `alpha` (n,), and of the proposals as far as the config asks; a scalar.
        `mask`, `known` (n,)."""
        c = self.config
        loss = mask_loss(alpha, mask, known, clamp=c.mask_clamp)
        for level in levels[:-1] if c.proposal_mask_share else ():
            proposed = mask_loss(level.weights.sum(-1), mask, known, clamp=c.mask_clamp)
            loss = loss + c.proposal_mask_share * proposed
        return loss

    def optimise(self, step: int, output: StepOutput) -> None:
        c = self.config
        self.optimiser.step(
            warm_up_and_decay(
                step, c.steps, first=c.lr, last=c.lr_final, warm_up=c.lr_warm_up, delay=c.lr_delay
            )
        )
        self.step_correction(step)

    def export(self, folder: Path) -> list[Path]:
        return export_mesh(Path(folder) / "mesh.ply", self.mesh())

    def mesh(self, resolution: int = MESH_RESOLUTION) -> FieldMesh | None:
        """The surface in the capture's frame; see `mesh_density`."""
        return mesh_density(
            self.density, self._colour, self.frame, 1.0, resolution=resolution, origin=self.origin
        )

    def own_bounds(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        near = torch.full(origins.shape[:-1], self.config.near, device=origins.device)
        return near, torch.full_like(near, self.config.far)

    def _mean_squares(self) -> list[Tensor]:
        """Of the table of each level (levels of the table,)."""
        return [self._grid(name).mean_squares() for name in LEVELS]

    def _see(
        self,
        rays: LocalRays,
        radius: Tensor,
        counts: Sequence[int],
        step: int,
        generator: Generator,
    ) -> tuple[list[Level], Tensor, list[Tensor]]:
        """All levels along rays in a training step, the field's outputs (n, S, ...), and the mean squares of the
        levels' tables, as `_look` has them."""
        level, progress = None, step / max(self.config.steps, 1)
        levels, squares = [], []
        for name, count, known in zip(LEVELS, counts, self._mean_squares(), strict=True):
            level, out, of_table = self._look(name, rays, radius, level, count, progress, generator, known)
            levels.append(level)
            squares.append(of_table)
        return levels, out, squares

    def _look(
        self,
        name: str,
        rays: LocalRays,
        radius: Tensor,
        before: Level | None,
        count: int,
        progress: float,
        generator: Generator | None,
        squares: Tensor,
    ) -> tuple[Level, Tensor, Tensor]:
        """One level, sampled where the level before saw something, its network's outputs (n, S, ...), and its mean
        squares with their gradient."""
        n = len(rays.near)
        if before is None:
            s, weights = rays.near.new_tensor([0.0, 1.0]), rays.near.new_ones(1)
        else:
            s, weights = before.s, before.weights.detach()
        s, t = sample_distances(
            s,
            weights,
            count,
            rays.near,
            rays.far,
            exponent=anneal_exponent(progress, self.config.anneal_slope),
            power=self.config.spacing_power,
            jitter=None if generator is None else uniform(generator, self.device, n, 1),
        )
        turn = None if generator is None else uniform(generator, self.device, n, count)
        points, std = multisample(rays.origins, rays.directions, t, radius, turn)
        out, squares = self.model[name](points, std, squares)
        density, out = density_of(out, self.config.density_bias)
        return Level(s, t, weights_from_density(density, t)[0]), out, squares

    @torch.no_grad()
    def render(self, camera: Cameras, background: Tensor) -> Render:
        # The tables stay as they are for a whole view.
        self._squares = self._mean_squares()
        try:
            return super().render(camera, background)
        finally:
            self._squares = None

    def render_rays(
        self, origins: Tensor, directions: Tensor, radius: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        # Level by level, for those rays that still may show something.
        rays = self.bound(origins, directions, self.hooks_at_inference())
        counts = self.config.test_samples or self.config.samples
        n = len(rays.near)
        background = background.to(rays.near.dtype)
        rgb, alpha, depth = background.expand(n, 3).clone(), torch.zeros_like(rays.near), rays.far.clone()
        left, level = rays.hit.nonzero()[:, 0], None
        rays = LocalRays(*(x[left] for x in rays))
        for name, count, squares in zip(LEVELS, counts, self._squares or self._mean_squares(), strict=True):
            if not len(left):
                return rgb, alpha, depth
            level, out, _ = self._look(name, rays, radius, level, count, 1.0, None, squares)
            # Proposals bound the field's weights from above: where they see nothing, it does not either.
            seen = (level.weights.sum(-1) > INVISIBLE).nonzero()[:, 0]
            left, out, level = left[seen], out[seen], Level(*(x[seen] for x in level))
            rays = LocalRays(*(x[seen] for x in rays))
        if level is not None and len(left):
            colours = self._shade(out, rays.directions[:, None])
            rgb[left], alpha[left], depth[left] = composite(level.weights, colours, level.t, background)
        return rgb, alpha, depth

    def _shade(self, seen: Tensor, directions: Tensor) -> Tensor:
        return self.model["colour"](seen, encode_sinusoids(directions, self.config.view_degree))

    def _grid(self, name: str) -> AntialiasedGrid:
        grid = self.model[name]
        assert isinstance(grid, AntialiasedGrid)
        return grid

    def _field(self, points: Tensor) -> Tensor:
        points = points.to(self.device)[:, None]
        # As one voxel of the finest level would be seen.
        std = torch.full_like(points[..., 0], 0.5 / self.config.grid.max_resolution)
        return self.model["field"](points, std)[0]

    def density(self, points: Tensor) -> Tensor:
        return density_of(self._field(points), self.config.density_bias)[0]

    def _colour(self, points: Tensor, directions: Tensor) -> Tensor:
        return self._shade(self._field(points), directions.to(self.device))
