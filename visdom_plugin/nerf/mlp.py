"""From encoded points to density and colour: the small networks of the radiance fields.

On the CPU a net of layers at most `WIDEST` wide runs as one kernel; wider ones, and other devices, in plain torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.nerf import mlp_kernels

CALLS = 32
"""About into how many calls the work on all points is divided, so that many threads have work."""
WIDEST = 96
"""Inputs or outputs of a layer. Beyond, a matrix product of torch's is as fast."""


class Perceptron(nn.Sequential):
    """Linear layers with ReLU between them; (..., inputs) to (..., outputs)."""

    def forward(self, x: Tensor, extra: Tensor | None = None, *, lead: int = 0) -> Tensor:
        """See `run_layers`."""
        return run_layers(self.layers, x, extra, lead=lead)

    @property
    def layers(self) -> list[nn.Linear]:
        return [layer for layer in self if isinstance(layer, nn.Linear)]


def run_layers(
    layers: Sequence[nn.Linear],
    x: Tensor,
    extra: Tensor | None = None,
    *,
    lead: int = 0,
    again: int | None = None,
) -> Tensor:
    """Linear layers with ReLU between them.

    Args:
        layers: from first to last; all with biases or all without.
        x: (n, lead + a) or (..., lead + a) input, of which the first `lead` numbers are left out. Differentiable.
        extra: (m, b) or (..., b), more of the input, behind x; each row serves n / m points in a row. A constant.
        again: the layer that is fed the whole input once more, behind the output of the layer before it.

    Returns:
        (..., outputs).
    """
    points, rest = x.reshape(-1, x.shape[-1]), None if extra is None else extra.detach().flatten(0, -2)
    parameters = parameters_of(layers)
    if x.device.type == "cpu" and x.dtype == torch.float32 and has_kernel(layers):
        out = _Layers.apply(points, rest, shape_of(layers, lead, again), *parameters)
    else:
        out = run_layers_torch(layers, points, rest, lead=lead, again=again)
    return out.reshape(*x.shape[:-1], layers[-1].out_features)


def run_layers_torch(
    layers: Sequence[nn.Linear], x: Tensor, extra: Tensor | None, *, lead: int = 0, again: int | None = None
) -> Tensor:
    """`run_layers` in plain torch, for x (n, lead + a) and extra (m, b)."""
    x = x[:, lead:]
    if extra is not None:
        x = torch.cat([x, extra.repeat_interleave(len(x) // max(len(extra), 1), 0)], -1)
    h = x
    for i, layer in enumerate(layers):
        if i:
            h = h.relu()
        if i == again:
            h = torch.cat([h, x], -1)
        h = layer(h)
    return h


class Shape(NamedTuple):
    """What a kernel has to know of a net beside its parameters."""

    sizes: tuple[tuple[int, int], ...]
    """Inputs and outputs of each layer."""
    biased: bool
    lead: int
    again: int
    """-1 for none."""


def has_kernel(layers: Sequence[nn.Linear]) -> bool:
    """Whether a net is one for the CPU's kernel."""
    widest = max(max(layer.in_features, layer.out_features) for layer in layers)
    return widest <= WIDEST and all(
        p.dtype == torch.float32 and p.device.type == "cpu" for p in parameters_of(layers)
    )


def parameters_of(layers: Sequence[nn.Linear]) -> list[Tensor]:
    """Weights and biases in the order in which kernels have them."""
    return [p for layer in layers for p in (layer.weight, layer.bias) if p is not None]


def shape_of(layers: Sequence[nn.Linear], lead: int = 0, again: int | None = None) -> Shape:
    """See `run_layers`."""
    sizes = tuple((layer.in_features, layer.out_features) for layer in layers)
    return Shape(sizes, layers[0].bias is not None, lead, -1 if again is None else again)


class _Layers(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, extra, shape, *parameters):
        x = x.contiguous()
        extra = x.new_empty(1, 0) if extra is None else extra.float().contiguous()
        ctx.save_for_backward(x, *parameters)
        repeat = max(len(x) // max(len(extra), 1), 1)
        net = prepare(shape, parameters, len(x), x.shape[1], extra.shape[1], repeat)
        ctx.net, ctx.extra = net, _flat(extra)
        out = torch.empty(len(x), shape.sizes[-1][1])
        _run(net, len(x), _flat(x), ctx.extra, _flat(out), NONE, NONE, NONE)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out):
        x, *parameters = ctx.saved_tensors
        g_x, sums = torch.empty_like(x), sums_of(ctx.net, len(x))
        gradients = _flat(g_out.contiguous()), _flat(g_x), sums.reshape(-1)
        _run(ctx.net, len(x), _flat(x), ctx.extra, NONE, *gradients)
        return g_x, None, None, *add_up(sums, parameters)


NONE = np.empty(0, np.float32)
"""In place of an array that is not wanted."""


def prepare(
    shape: Shape, parameters: Sequence[Tensor], points: int, x_row: int, extra_row: int = 0, repeat: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `mlp_kernels.run` is told of a net, its points, and of how many of them in a row have the same row of
    `extra`."""
    numbers = np.array([points, x_row, shape.lead, extra_row, repeat, shape.again, shape.biased])
    sizes = np.array([*shape.sizes, (shape.sizes[-1][1], 0)], np.int64)
    return numbers, sizes, np.concatenate([_flat(p) for p in parameters])


def grain_of(points: int) -> tuple[int, int]:
    """Pieces of so many points, and how many of them a call takes: it packs the parameters before it begins."""
    pieces = -(-points // mlp_kernels.PIECE)
    return pieces, max(pieces // CALLS, 1)


def sums_of(net: tuple[np.ndarray, ...], points: int) -> np.ndarray:
    """Room for the gradients (pieces, parameters) of a prepared net."""
    return np.empty((grain_of(points)[0], len(net[2])), np.float32)


def add_up(sums: np.ndarray, parameters: Sequence[Tensor]) -> list[Tensor]:
    """Gradients of the parameters from those of the pieces."""
    split = torch.from_numpy(sums.sum(0)).split([p.numel() for p in parameters])
    return [g.view_as(p) for g, p in zip(split, parameters, strict=True)]


def _run(net: tuple[np.ndarray, ...], points: int, *arrays: np.ndarray) -> None:
    parallel_for(mlp_kernels.run, *grain_of(points), *net, *arrays)


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy().reshape(-1)


Layer: TypeAlias = nn.Linear | nn.Conv1d | nn.Conv2d | nn.Conv3d


@torch.no_grad()
def draw_weights(layer: Layer, most: float, generator: Generator) -> None:
    """Makes a layer's weights uniform within +-most, drawn on the CPU, and its biases zero."""
    layer.weight.copy_((2 * torch.rand(layer.weight.shape, generator=generator) - 1) * most)
    if layer.bias is not None:
        layer.bias.zero_()


def perceptron(sizes: Sequence[int], generator: Generator, *, bias: bool = False) -> Perceptron:
    """Linear layers with ReLU between them, weights uniform within +-sqrt(6 / inputs) (He et al. 2015).

    The last layer, which has no ReLU behind it, takes +-sqrt(3 / inputs). Without biases, as in Instant-NGP,
    features of zero give zero: space that no sample has touched keeps its first density.

    Args:
        sizes: numbers per point before the first layer, between the layers, and behind the last.
        generator: on the CPU.
    """
    layers: list[nn.Module] = []
    for i, (n, m) in enumerate(pairwise(sizes)):
        last = i + 2 == len(sizes)
        layer = nn.Linear(n, m, bias=bias)
        draw_weights(layer, math.sqrt((3 if last else 6) / n), generator)
        layers += [layer] if last else [layer, nn.ReLU(inplace=True)]
    return Perceptron(*layers)
