"""From encoded points to density and colour: the small networks of the radiance fields."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import torch
from torch import Generator, Tensor, nn


class TruncatedExp(torch.autograd.Function):
    """exp whose gradient is cut off above exp(15), so that one wild density does not end the training.

    As in Instant-NGP and torch-ngp.
    """

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        y = torch.exp(x.clamp(max=30))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return gradient * y.clamp(max=math.exp(15))


truncated_exp = TruncatedExp.apply


Layer: TypeAlias = nn.Linear | nn.Conv1d | nn.Conv2d | nn.Conv3d


@torch.no_grad()
def draw_weights(layer: Layer, most: float, generator: Generator) -> None:
    """Makes a layer's weights uniform within +-most, drawn on the CPU, and its biases zero."""
    layer.weight.copy_((2 * torch.rand(layer.weight.shape, generator=generator) - 1) * most)
    if layer.bias is not None:
        layer.bias.zero_()


def perceptron(sizes: Sequence[int], generator: Generator, *, bias: bool = False) -> nn.Sequential:
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
    return nn.Sequential(*layers)
