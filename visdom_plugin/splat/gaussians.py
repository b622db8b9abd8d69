"""Gaussians: the plain parameters of a splatting model."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass
class Gaussians:
    """N anisotropic Gaussians before activation, as 3DGS stores them (Kerbl et al. 2023)."""

    means: Tensor
    """(N, 3) world frame."""
    log_scales: Tensor
    """(N, 3) natural logarithms of the standard deviations along the axes, scene units."""
    quaternions: Tensor
    """(N, 4) world from Gaussian axes, order w, x, y, z, of any length but zero."""
    opacity_logits: Tensor
    """(N,) opacity = sigmoid(logit)."""
    sh: Tensor
    """(N, B, 3) spherical harmonics of the colour, B = (degree + 1)^2, the constant first."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def n(self) -> int:
        """Number of Gaussians."""
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Degree of the stored harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> dict[str, Tensor]:
        """The parameters by name, in the order of the fields."""
        return {name: getattr(self, name) for name in NAMES}

    def to(self, device=None, dtype: torch.dtype | None = None) -> Gaussians:
        """The same Gaussians on another device or in another floating dtype."""
        return Gaussians(**{k: v.to(device=device, dtype=dtype) for k, v in self.tensors().items()})

    def detach(self) -> Gaussians:
        """The same numbers outside the graph."""
        return Gaussians(**{k: v.detach() for k, v in self.tensors().items()})


NAMES = tuple(f.name for f in fields(Gaussians))
