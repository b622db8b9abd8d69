"""Viewing directions as features of a colour net. No gradient: poses are fixed."""

from __future__ import annotations

import inspect

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.harmonics import C0, basis, higher

DIRECTIONS_PER_PIECE = 4096


def encode_harmonics(directions: Tensor) -> Tensor:
    """The 16 real spherical harmonics of degrees 0 to 3, which instant-ngp calls degree 4.

    Args:
        directions: (..., 3) unit length.

    Returns:
        (..., 16) in the order and with the signs of `visdom_plugin.geometry.harmonics`.
    """
    flat = directions.detach().reshape(-1, 3)
    if flat.device.type == "cpu":
        out = np.empty((len(flat), 16), flat.contiguous().numpy().dtype)
        parallel_for(_harmonics, len(flat), DIRECTIONS_PER_PIECE, flat.contiguous().numpy(), out)
        return torch.from_numpy(out).reshape(*directions.shape[:-1], 16)
    return _harmonics_torch(flat).reshape(*directions.shape[:-1], 16)


def _harmonics_torch(directions: Tensor) -> Tensor:
    """The kernel's own lines, each on all directions (N, 3) at once."""
    x, y, z = directions.unbind(-1)
    return torch.stack([torch.full_like(x, C0), *inspect.unwrap(higher)(x, y, z)], -1)


def encode_sinusoids(directions: Tensor, degree: int = 4) -> Tensor:
    """Zip-NeRF's: the directions, then their sines and cosines at frequencies 1, 2, ... 2^(degree - 1).

    Args:
        directions: (..., 3) unit length.

    Returns:
        (..., 3 + 6 degree).
    """
    directions = directions.detach()
    frequencies = 2.0 ** torch.arange(degree, dtype=directions.dtype, device=directions.device)
    phases = (frequencies[:, None] * directions[..., None, :]).flatten(-2)
    return torch.cat([directions, torch.sin(phases), torch.cos(phases)], -1)


@kernel(error_model="numpy")
def _harmonics(begin, end, directions, out):
    for i in range(begin, end):
        basis(3, directions[i, 0], directions[i, 1], directions[i, 2], out[i])
