"""Features of points in a cube from few tensors made from frozen noise: planes times lines, or two volumes."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import grid_sample

from visdom_plugin.nerf.encoding.noise_decoders import PlaneDecoder, StackDecoder

PLANES = ((0, 1), (1, 2), (2, 0))
"""Axes of the planes; each is multiplied with the line along the third axis."""
LINES = (2, 0, 1)


class Factors(nn.Module, ABC):
    """Tensors over the cube [-1, 1]^3, their networks and the noise these start from."""

    width: int
    """Features of a point."""

    @abstractmethod
    def make(self) -> list[Tensor]:
        """The tensors as the networks make them now; differentiable."""

    @abstractmethod
    def look_up(self, points: Tensor, made: list[Tensor]) -> Tensor:
        """Features (m, width) of points (m, 3), from what `make` gave; beside the cube those of its faces."""


class PlanesTimesLines(Factors):
    """TensoRF's: for each pair of axes a plane, times the line along the third axis; side by side.

    Args:
        noise_channels, noise_resolution: of the noise; planes and lines are 16 times as fine.
        channels: of each plane and line.
        width: see `PlaneDecoder`.
        generator: on the CPU; draws noise and weights.
    """

    def __init__(
        self, noise_channels: int, noise_resolution: int, channels: int, width: int, generator: Generator
    ):
        super().__init__()
        self.width = 3 * channels
        self.plane_noise: Tensor
        self.line_noise: Tensor
        self.planes = nn.ModuleList(PlaneDecoder(noise_channels, channels, width, generator) for _ in PLANES)
        self.lines = nn.ModuleList(StackDecoder(1, noise_channels, channels, width, generator) for _ in LINES)
        shape = (3, 1, noise_channels, noise_resolution)
        self.register_buffer("plane_noise", torch.randn(*shape, noise_resolution, generator=generator))
        self.register_buffer("line_noise", torch.randn(shape, generator=generator))

    def make(self) -> list[Tensor]:
        planes = [net(noise) for net, noise in zip(self.planes, self.plane_noise, strict=True)]
        lines = [net(noise)[..., None] for net, noise in zip(self.lines, self.line_noise, strict=True)]
        return planes + lines

    def look_up(self, points: Tensor, made: list[Tensor]) -> Tensor:
        features = []
        for axes, axis, plane, line in zip(PLANES, LINES, made[:3], made[3:], strict=True):
            # Of a line, which is a plane of one column, the first coordinate says nothing.
            on_line = torch.stack([torch.zeros_like(points[:, axis]), points[:, axis]], -1)
            features.append(_sample(plane, points[:, axes]) * _sample(line, on_line))
        return torch.cat(features).T


class TwoVolumes(Factors):
    """Two volumes side by side: one over the whole cube, one that repeats every `period` along each axis.

    Args:
        period: in the unit of the cube's half side.
        noise_channels, noise_resolution, channels, width, generator: as for `PlanesTimesLines`; the volumes are 8
            times as fine as the noise.
    """

    def __init__(
        self,
        noise_channels: int,
        noise_resolution: int,
        channels: int,
        width: int,
        period: float,
        generator: Generator,
    ):
        super().__init__()
        self.width, self.period = 2 * channels, period
        self.noise: Tensor
        self.volumes = nn.ModuleList(
            StackDecoder(3, noise_channels, channels, width, generator) for _ in range(2)
        )
        shape = (2, 1, noise_channels, *(noise_resolution,) * 3)
        self.register_buffer("noise", torch.randn(shape, generator=generator))

    def make(self) -> list[Tensor]:
        return [net(noise) for net, noise in zip(self.volumes, self.noise, strict=True)]

    def look_up(self, points: Tensor, made: list[Tensor]) -> Tensor:
        repeated = points.remainder(self.period) * (2 / self.period) - 1
        return torch.cat([_sample(made[0], points), _sample(made[1], repeated)]).T


def _sample(tensor: Tensor, points: Tensor) -> Tensor:
    """(C, m) linear interpolation of a tensor (1, C, ..., h, w) at points (m, d) in [-1, 1], last axis first."""
    at = points.reshape(1, *(1,) * (points.shape[-1] - 1), *points.shape)
    found = grid_sample(tensor, at, padding_mode="border", align_corners=False)
    return found.reshape(tensor.shape[1], len(points))
