"""Convolutional networks that make lines, planes or volumes from frozen noise, as ZeroRF (Shi et al. 2023) does.

What is trained is the network alone. What it can make from noise in few steps is smooth and self-similar, which is
the only prior there is (Ulyanov et al. 2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import interpolate, silu

from visdom_plugin.nerf.mlp import Layer, draw_weights

PLANE_WIDTHS = (8, 4, 2, 2, 1)
"""Channels of a plane's levels as multiples of the finest one's, from coarse to fine, each twice as fine."""
STACK_WIDTHS = (4, 4, 4, 2, 1, 1)
"""The same for lines and volumes, before and behind each convolution."""
STACK_FINENESS = {1: (2, 4, 8, 16, 16), 3: (1, 1, 2, 4, 8)}
"""How much finer than the noise lines and volumes are behind each convolution."""
PLANE_GROUPS, STACK_GROUPS = 32, 16
"""Most groups of channels that are normalised together."""


class PlaneDecoder(nn.Module):
    """Noise (1, C, r, r) to a plane (1, outputs, 16 r, 16 r): residual blocks, attention on the coarsest level.

    Args:
        inputs: channels of the noise.
        width: channels of the finest level; a coarse one has up to eight times as many.
        generator: on the CPU; draws the weights.
        multiples: channels of the five levels in widths, from coarse to fine.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        width: int,
        generator: Generator,
        multiples: Sequence[int] = PLANE_WIDTHS,
    ):
        super().__init__()
        widths = [width * n for n in multiples]
        self.first = _convolution(inputs, widths[0], generator)
        self.middle = nn.Sequential(
            Residual(widths[0], widths[0], generator),
            Attention(widths[0], generator),
            Residual(widths[0], widths[0], generator),
        )
        self.levels = nn.ModuleList(
            nn.Sequential(Residual(n, m, generator), Residual(m, m, generator))
            for n, m in zip([widths[0], *widths[:-1]], widths, strict=True)
        )
        self.refine = nn.ModuleList(_convolution(m, m, generator) for m in widths[:-1])
        self.norm = _norm(widths[-1])
        self.last = _convolution(widths[-1], outputs, generator)

    def forward(self, noise: Tensor) -> Tensor:
        x = self.middle(self.first(noise))
        for level, refine in zip(self.levels[:-1], self.refine, strict=True):
            x = refine(interpolate(level(x), scale_factor=2, mode="nearest"))
        return self.last(silu(self.norm(self.levels[-1](x))))


class StackDecoder(nn.Module):
    """Noise (1, C, r) to a line (1, outputs, 16 r), or (1, C, r, r, r) to a volume of eight times the resolution.

    Args:
        dimensions: 1 for lines, 3 for volumes.
        inputs, width, generator: as for `PlaneDecoder`.
    """

    def __init__(self, dimensions: int, inputs: int, outputs: int, width: int, generator: Generator):
        super().__init__()
        widths = [width * n for n in STACK_WIDTHS]
        self.fineness = STACK_FINENESS[dimensions]
        self.mode = "linear" if dimensions == 1 else "nearest"
        self.first = _plain_convolution(dimensions, inputs, widths[0], generator)
        self.layers = nn.ModuleList(
            nn.Sequential(
                _plain_convolution(dimensions, n, m, generator),
                nn.GroupNorm(math.gcd(STACK_GROUPS, m), m),
                nn.SiLU(),
            )
            for n, m in pairwise(widths)
        )
        self.last = _plain_convolution(dimensions, widths[-1], outputs, generator)

    def forward(self, noise: Tensor) -> Tensor:
        x = self.first(noise)
        for layer, fineness in zip(self.layers, self.fineness, strict=True):
            x = interpolate(layer(x), size=[fineness * n for n in noise.shape[2:]], mode=self.mode)
        return silu(self.last(x))


class Residual(nn.Module):
    """Two convolutions (1, inputs, h, w) to (1, outputs, h, w), added to what comes in; the second starts at 0."""

    def __init__(self, inputs: int, outputs: int, generator: Generator):
        super().__init__()
        self.norms = nn.ModuleList([_norm(inputs), _norm(outputs)])
        self.first = _convolution(inputs, outputs, generator)
        self.second = _convolution(outputs, outputs, generator)
        nn.init.zeros_(self.second.weight)
        self.skip = nn.Identity() if inputs == outputs else _convolution(inputs, outputs, generator, size=1)

    def forward(self, x: Tensor) -> Tensor:
        inner = self.first(silu(self.norms[0](x)))
        return self.skip(x) + self.second(silu(self.norms[1](inner)))


class Attention(nn.Module):
    """Every pixel of (1, width, h, w) looks at every other; starts as the identity."""

    def __init__(self, width: int, generator: Generator):
        super().__init__()
        self.norm = _norm(width)
        self.ask = nn.Linear(width, 3 * width)
        self.answer = nn.Linear(width, width)
        draw_weights(self.ask, 1 / math.sqrt(width), generator)
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)

    def forward(self, x: Tensor) -> Tensor:
        pixels = self.norm(x).flatten(2).mT
        query, key, value = self.ask(pixels).chunk(3, -1)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value)
        return x + self.answer(mixed).mT.reshape(x.shape)


def _norm(width: int) -> nn.GroupNorm:
    return nn.GroupNorm(math.gcd(PLANE_GROUPS, width), width, eps=1e-6)


def _convolution(inputs: int, outputs: int, generator: Generator, size: int = 3) -> nn.Conv2d:
    """With a bias, its weights normal with variance 2 / (outputs size^2) (He et al. 2015)."""
    layer = nn.Conv2d(inputs, outputs, size, padding=size // 2)
    with torch.no_grad():
        std = math.sqrt(2 / (outputs * size**2))
        layer.weight.copy_(std * torch.randn(layer.weight.shape, generator=generator))
        layer.bias.zero_()  # type: ignore[union-attr]  # it has one
    return layer


def _plain_convolution(dimensions: int, inputs: int, outputs: int, generator: Generator) -> Layer:
    """Without a bias, its weights uniform within +-1 / sqrt(inputs 3^d)."""
    kind = nn.Conv1d if dimensions == 1 else nn.Conv3d
    layer = kind(inputs, outputs, 3, padding=1, bias=False)
    draw_weights(layer, 1 / math.sqrt(inputs * 3**dimensions), generator)
    return layer
