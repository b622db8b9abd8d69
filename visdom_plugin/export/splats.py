"""Gaussians cropped, moved and turned, with their harmonics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.geometry.harmonics import basis
from visdom_plugin.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from visdom_plugin.splat.gaussians import Gaussians


def take(gaussians: Gaussians, chosen: Tensor) -> Gaussians:
    """Some of the Gaussians: (N,) bool, or their numbers."""
    return Gaussians(**{name: value[chosen] for name, value in gaussians.tensors().items()})


def crop(gaussians: Gaussians, inside: Callable[[Tensor], Tensor]) -> Gaussians:
    """The Gaussians whose centres are inside; `inside` takes points (n, 3) to (n,) bool."""
    return take(gaussians, inside(gaussians.means))


def move(gaussians: Gaussians, motion: Tensor) -> Gaussians:
    """The Gaussians moved by a rigid motion (4, 4) float64; a camera that moves with them sees the same."""
    rotation = motion[:3, :3].double()
    turned = rotation @ matrix_from_quaternion(gaussians.quaternions.double())
    return Gaussians(
        (gaussians.means.double() @ rotation.mT + motion[:3, 3].double()).float(),
        gaussians.log_scales,
        quaternion_from_matrix(turned).float(),
        gaussians.opacity_logits,
        torch.einsum(
            "ab,nbc->nac", turn_harmonics(rotation, gaussians.degree), gaussians.sh.double()
        ).float(),
    )


def turn_harmonics(rotation: Tensor, degree: int) -> Tensor:
    """(B, B) float64 with which coefficients are multiplied when what they colour is turned, B = (degree + 1)^2.

    Each degree's functions span a space that rotations map to itself, so the values at enough directions
    determine the matrix: basis(R d) M = basis(d) for all d.
    """
    size = (degree + 1) ** 2
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(8 * size, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    before, after = (_evaluate(d.numpy(), degree) for d in (directions, directions @ rotation.mT))
    matrix = torch.linalg.lstsq(after, before).solution
    return torch.where(matrix.abs() < 1e-12, 0, matrix)


def _evaluate(directions: np.ndarray, degree: int) -> Tensor:
    values = np.zeros((len(directions), 16))
    for row, (x, y, z) in zip(values, directions, strict=True):
        basis(degree, x, y, z, row)
    return torch.from_numpy(values[:, : (degree + 1) ** 2])
