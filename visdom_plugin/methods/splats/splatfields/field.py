"""The neural field of SplatFields: three planes that networks make from frozen noise, and a small MLP."""

from __future__ import annotations

import torch
from torch import Generator, Tensor, nn

from visdom_plugin.methods.splats.splatfields.config import SplatFieldsConfig
from visdom_plugin.nerf.encoding.noise_decoders import PlaneDecoder
from visdom_plugin.nerf.mlp import perceptron
from visdom_plugin.splat.gaussians import Gaussians

PLANES = ((0, 1), (1, 2), (2, 0))
"""Axes of the three planes."""
EVEN = (1, 1, 1, 1, 1)
"""All levels of a plane's network have the same width."""
OFFSET = 0.01
"""What a number 1 of the field moves a Gaussian by, in extents: a step of the optimiser moves Gaussians about as
far as one of 3DGS does."""
MARGIN = 1.1
"""Of the box that the planes cover, in boxes of the points at the start."""


class TriplaneField(nn.Module):
    """What the Gaussians at given places look like; at the start, as they did without it.

    Args:
        config: sizes.
        means: (N, 3) where Gaussians start; the planes cover their box. Beyond it they go on as at its edge.
        harmonics: numbers B of harmonics per channel.
        extent: the scene's, in the unit of `means`.
        generator: on the CPU; draws noise and weights.
    """

    def __init__(
        self, config: SplatFieldsConfig, means: Tensor, harmonics: int, extent: float, generator: Generator
    ):
        super().__init__()
        c, self.harmonics, self.extent = config, harmonics, extent
        low, high = means.detach().amin(0), means.detach().amax(0)
        self.centre = nn.Buffer((low + high) / 2)
        self.half_side = nn.Buffer((MARGIN / 2 * (high - low).amax()).clamp_min(1e-6))
        noise = torch.randn(len(PLANES), c.noise_channels, c.noise_size, c.noise_size, generator=generator)
        self.noise = nn.Buffer(noise)
        self.decoders = nn.ModuleList(
            PlaneDecoder(c.noise_channels, c.plane_channels, c.decoder_width, generator, EVEN) for _ in PLANES
        )
        sizes = [len(PLANES) * c.plane_channels, *[c.mlp_width] * c.mlp_depth]
        self.trunk = nn.Sequential(perceptron(sizes, generator, bias=True), nn.ReLU())
        self.sizes = (3, 3, 4, 1, 3 * harmonics)
        """Numbers of an offset, a scale, a rotation, an opacity and a colour."""
        self.head = nn.Linear(c.mlp_width, sum(self.sizes))
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def planes(self) -> Tensor:
        """(3, C, 16 r, 16 r), made from the noise."""
        made = [decoder(self.noise[i : i + 1]) for i, decoder in enumerate(self.decoders)]
        return torch.cat(made)

    def forward(self, own: Gaussians, planes: Tensor) -> Gaussians:
        """What is drawn of Gaussians: what they were at the start or after a split, and what the field adds."""
        means = own.means.detach()
        place = (means - self.centre) / self.half_side
        grid = torch.stack([place[:, axes] for axes in PLANES])[:, None]
        features = nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)
        added = self.head(self.trunk(features[:, :, 0].flatten(0, 1).T))
        offset, scale, rotation, opacity, colour = added.split(self.sizes, -1)
        return Gaussians(
            means + OFFSET * self.extent * offset,
            own.log_scales.detach() + scale,
            own.quaternions.detach() + rotation,
            own.opacity_logits.detach() + opacity[:, 0],
            own.sh.detach() + colour.reshape(-1, self.harmonics, 3),
        )
