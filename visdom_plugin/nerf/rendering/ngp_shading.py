"""Instant-NGP's field along rays as one operation on the CPU: hash grid, both networks, and compositing.

Autograd sees one function where it saw ten. A thread takes its samples through all kernels of the way there, or
back, before it takes others, so that they are in its cache, and threads are woken once for all of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.nerf import activations, mlp, mlp_kernels
from visdom_plugin.nerf.encoding import hash_kernels
from visdom_plugin.nerf.encoding.hash_cpu import describe
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.nerf.encoding.view_directions import encode_harmonics
from visdom_plugin.nerf.mlp import NONE, Perceptron
from visdom_plugin.nerf.rendering import volume_packed
from visdom_plugin.nerf.sampling.occupancy_grid import PackedSamples, find_middles


class NgpField(NamedTuple):
    """A hash grid over the cube [-half_side, half_side]^3 and the networks behind it."""

    layout: HashLayout
    table: Tensor
    density_net: Perceptron
    """Features to outputs, of which the first is the density's logarithm without `density_bias`."""
    colour_net: Perceptron
    """The other outputs, and spherical harmonics of the viewing direction, to colours before their sigmoid."""
    half_side: float
    density_bias: float

    def has_kernels(self) -> bool:
        """Whether `shade` takes it."""
        plain = self.table.device.type == "cpu" and self.table.dtype == torch.float32
        return plain and all(mlp.has_kernel(net.layers) for net in (self.density_net, self.colour_net))


def shade(
    field: NgpField, origins: Tensor, directions: Tensor, samples: PackedSamples, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, alpha and depth of rays, as `composite_packed` has them.

    Args:
        field: differentiable in its table and its networks' parameters.
        origins, directions: (n, 3) float32 in the field's frame.
        background: (n, 3), a constant.
    """
    parameters = (p for net in (field.density_net, field.colour_net) for p in mlp.parameters_of(net.layers))
    rgb, alpha, depth = _Shade.apply(
        field, origins, directions, samples, background, field.table, *parameters
    )
    return rgb, alpha, depth


class _Samples:
    """Arrays of all samples, and what a thread does with some of them."""

    def __init__(self, field: NgpField, origins: Tensor, directions: Tensor, samples: PackedSamples):
        self.count = count = len(samples.ray)
        self.layout, self.table = field.layout, field.table.detach().numpy().reshape(-1)
        self.scale, self.bias = np.float32(0.5 / field.half_side), np.float32(field.density_bias)
        first, second = mlp.shape_of(field.density_net.layers), mlp.shape_of(field.colour_net.layers, lead=1)
        self.parameters = [mlp.parameters_of(net.layers) for net in (field.density_net, field.colour_net)]
        width, self.outputs = first.sizes[0][0], first.sizes[-1][1]
        seen = second.sizes[0][0] - (self.outputs - 1)
        self.density_net = mlp.prepare(first, self.parameters[0], count, width)
        self.colour_net = mlp.prepare(second, self.parameters[1], count, self.outputs, seen)
        self.rays = [x.detach().contiguous().numpy() for x in (origins, directions, *samples[1:])]
        self.views = encode_harmonics(directions)[:, :seen].contiguous().numpy()
        self.unit, self.density, self.rgb = (np.empty((count, *k), np.float32) for k in ((3,), (), (3,)))
        self.looks = np.empty((count, seen), np.float32)
        self.features, self.out = (np.empty(count * k, np.float32) for k in (width, self.outputs))

    def see(self, begin: int, end: int) -> None:
        """Density and colours of pieces begin .. end - 1."""
        first, last = begin * mlp_kernels.PIECE, min(end * mlp_kernels.PIECE, self.count)
        origins, directions, ray, starts, ends = self.rays
        find_middles(first, last, origins, directions, ray, starts, ends, self.unit)
        unit = self.unit[first:last]
        unit *= self.scale
        unit += np.float32(0.5)
        width = self.layout.width
        blocks = -(-len(unit) // hash_kernels.BLOCK)
        hash_kernels.encode(
            0, self.layout.levels * blocks, 1, unit.reshape(-1), NONE, self.table, self.layout.features,
            *describe(self.layout), NONE, self.features[first * width : last * width], NONE,
        )  # fmt: skip
        mlp_kernels.run(begin, end, *self.density_net, self.features, NONE, self.out, NONE, NONE, NONE)
        activations.find_density(first, last, self.outputs, self.bias, self.out, self.density)
        self.views.take(ray[first:last], 0, self.looks[first:last])
        colours = self.rgb.reshape(-1)
        mlp_kernels.run(
            begin, end, *self.colour_net, self.out, self.looks.reshape(-1), colours, NONE, NONE, NONE
        )
        activations.find_sigmoid(3 * first, 3 * last, colours, np.float32(0), colours)

    def start_back(self, by_density: np.ndarray, by_rgb: np.ndarray) -> None:
        self.by_density, self.by_rgb = by_density, by_rgb.reshape(-1)
        self.by_out, self.by_features = np.empty_like(self.out), np.empty_like(self.features)
        self.sums = [mlp.sums_of(net, self.count) for net in (self.density_net, self.colour_net)]

    def go_back(self, begin: int, end: int) -> None:
        """Gradients by the features of pieces begin .. end - 1, and the pieces' share in those of the networks."""
        first, last = begin * mlp_kernels.PIECE, min(end * mlp_kernels.PIECE, self.count)
        colours, by_rgb, by_out = self.rgb.reshape(-1), self.by_rgb, self.by_out
        density_sums, colour_sums = (sums.reshape(-1) for sums in self.sums)
        activations.sigmoid_back(3 * first, 3 * last, colours, np.float32(0), by_rgb, by_rgb)
        looks = self.looks.reshape(-1)
        mlp_kernels.run(begin, end, *self.colour_net, self.out, looks, NONE, by_rgb, by_out, colour_sums)
        activations.density_back(first, last, self.outputs, self.density, self.by_density, by_out, by_out)
        mlp_kernels.run(
            begin, end, *self.density_net, self.features, NONE, NONE, by_out, self.by_features, density_sums
        )

    def scatter(self) -> np.ndarray:
        """The table's gradient, flat."""
        by_table, layout = np.empty_like(self.table), self.layout
        parallel_for(
            hash_kernels.encode_backward, layout.levels, 1, 1, self.unit.reshape(-1), NONE, self.by_features,
            layout.features, *describe(layout), NONE, NONE, by_table,
        )  # fmt: skip
        return by_table


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        field: NgpField,
        origins: Tensor,
        directions: Tensor,
        samples: PackedSamples,
        background: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        along = _Samples(field, origins, directions, samples)
        parallel_for(along.see, *mlp.grain_of(along.count))
        given = [x.detach().contiguous().numpy() for x in (samples.ray_offsets, background)]
        n, real = len(background), np.float32
        colour, alpha, depth = np.empty((n, 3), real), np.empty(n, real), np.empty(n, real)
        weights, passed = np.empty(along.count, real), np.empty(along.count, real)
        arrays = along.rgb, *along.rays[3:], *given
        out = colour, alpha, depth
        pieces = volume_packed.RAYS_PER_PIECE
        parallel_for(volume_packed.compose, n, pieces, along.density, *arrays, *out, weights, passed)
        ctx.along, ctx.arrays = along, (*arrays, alpha, depth, weights, passed)
        return tuple(torch.from_numpy(x) for x in out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        along, arrays = ctx.along, ctx.arrays
        by_density, by_rgb, by_background = (np.empty_like(x) for x in (along.density, along.rgb, arrays[4]))
        given = [g.contiguous().numpy() for g in slopes]
        out = by_density, by_rgb, by_background
        pieces = volume_packed.RAYS_PER_PIECE
        parallel_for(volume_packed.compose_back, len(by_background), pieces, *arrays, *given, *out)
        along.start_back(by_density, by_rgb)
        parallel_for(along.go_back, *mlp.grain_of(along.count))
        by_table = torch.from_numpy(along.scatter()).view(-1, along.layout.features)
        nets = zip(along.sums, along.parameters, strict=True)
        return *[None] * 5, by_table, *(g for sums, of in nets for g in mlp.add_up(sums, of))
