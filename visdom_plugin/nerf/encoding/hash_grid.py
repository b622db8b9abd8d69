"""Multiresolution hash encoding (Instant-NGP) and Zip-NeRF's multisampled, downweighted version of it.

Backends: "cpu" (numba, CPU tensors), "triton" (CUDA tensors), "torch" (plain operations on any device, also the
reference in tests). By default CPU tensors take "cpu" and CUDA tensors "triton" where Triton can be imported, else
"torch". The Triton kernels are tested against "torch" in Triton's interpreter; they were never timed on a GPU.
On the CPU results repeat to the bit, whatever the number of threads. On CUDA the gradient is summed by atomic
additions and does not.
"""

from __future__ import annotations

import importlib.util
from functools import cache

import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.nerf.encoding.hash_layout import HashLayout

__all__ = [
    "HashLayout",
    "encode",
    "encode_mean",
    "encode_spread",
    "initial_table",
    "mean_square_per_level",
    "warm_up",
]


def encode(points: Tensor, table: Tensor, layout: HashLayout, backend: str | None = None) -> Tensor:
    """Features of points, interpolated trilinearly on every level.

    Args:
        points: (..., 3) in [0, 1]^3; what lies outside is clamped to the box. They get no gradient.
        table: (layout.rows, layout.features) float32; gets a gradient.
        backend: one of BACKENDS; None chooses by the table's device.

    Returns:
        (..., layout.width): the features of the coarsest level first.
    """
    features, _ = _encode(points[..., None, :], None, table, layout, backend)
    return features


def encode_mean(
    points: Tensor, scales: Tensor, table: Tensor, layout: HashLayout, backend: str | None = None
) -> tuple[Tensor, Tensor]:
    """Features of groups of S points, each downweighted where a level is too fine for it, and averaged.

    A point's features of a level are multiplied by w = erf(1 / (sqrt(8) scale resolution)), as in Zip-NeRF
    (Barron et al. 2023, section 3.1). The fast versions compute erf within 1e-6 relative.

    Args:
        points: (..., S, 3) in [0, 1]^3, clamped.
        scales: (..., S) standard deviation of each point's Gaussian in the same units; 0 means w = 1.
        table: (layout.rows, layout.features) float32; the only input that gets a gradient.
        backend: one of BACKENDS; None chooses by the table's device.

    Returns:
        features (..., layout.width), and the mean weights (..., levels) in [0, 1], without gradient.
    """
    if scales.shape != points.shape[:-1]:
        raise ValueError(f"scales {tuple(scales.shape)} for points {tuple(points.shape)}")
    return _encode(points, scales, table, layout, backend)


def encode_spread(
    points: Tensor, scales: Tensor, table: Tensor, layout: HashLayout, squares: Tensor, initial: float
) -> tuple[Tensor, Tensor, Tensor]:
    """`encode_mean` as Zip-NeRF's networks see it, by default backends.

    Args:
        squares: (levels,) `mean_square_per_level` of the table as it is, without gradient.
        initial: largest feature of the table that training began with.

    Returns:
        features (..., layout.width); what the levels have left out, (..., levels): (2 w - 1) times the size of a
        level's features, sqrt(initial^2 + square), with w the mean weights, without gradient; and the squares
        once more, with a gradient, which is found in one go with the features'.
    """
    spans = (initial**2 + squares).sqrt()
    if default_backend(table.device) == "cpu":
        return _encode(points, scales, table, layout, "cpu", spans, squares)
    features, weights = encode_mean(points, scales, table, layout)
    return features, (2 * weights - 1) * spans, mean_square_per_level(table, layout)


def initial_table(layout: HashLayout, generator: torch.Generator, scale: float = 1e-4) -> Tensor:
    """(layout.rows, layout.features) uniform in [-scale, scale], on the generator's device."""
    noise = torch.rand(layout.rows, layout.features, generator=generator, device=generator.device)
    return (2 * noise - 1) * scale


def mean_square_per_level(table: Tensor, layout: HashLayout) -> Tensor:
    """(levels,) mean of the squared features of each level; Zip-NeRF's hash decay is a multiple of their sum."""
    constant = not (torch.is_grad_enabled() and table.requires_grad)
    if constant and table.device.type == "cpu" and table.dtype == torch.float32:
        from visdom_plugin.nerf.encoding.hash_cpu import mean_squares

        return mean_squares(table, layout)
    return torch.stack([rows.square().mean() for rows in table.split(layout.sizes)])


def warm_up(layout: HashLayout, device: torch.device | str = "cpu") -> None:
    """Compiles the kernels of a training step, or loads them from a cache; later calls are free."""
    table = torch.zeros(layout.rows, layout.features, device=device, requires_grad=True)
    point = torch.zeros(1, 1, 3, device=device)
    (
        encode(point, table, layout).sum() + encode_mean(point, point[..., 0], table, layout)[0].sum()
    ).backward()


def _encode(
    points: Tensor,
    scales: Tensor | None,
    table: Tensor,
    layout: HashLayout,
    backend: str | None,
    *more: Tensor,
):
    """(..., S, 3), (..., S) or None -> (..., width), (..., levels) or None, and what else the backend returns."""
    if table.shape != (layout.rows, layout.features):
        raise ValueError(
            f"a table of shape {tuple(table.shape)}, a layout of {(layout.rows, layout.features)}"
        )
    if points.shape[-1] != 3 or points.shape[-2] < 1:
        raise ValueError(f"points of shape {tuple(points.shape)}")
    run = _backend(backend or default_backend(table.device))
    *leading, samples, _ = points.shape
    points = points.detach().to(table.dtype).reshape(-1, samples, 3)
    if scales is not None:
        scales = scales.detach().to(table.dtype).reshape(-1, samples)
    features, weights, *rest = run(points, scales, table, layout, *more)
    if scales is not None:
        weights = weights.reshape(*leading, layout.levels)
    return features.reshape(*leading, layout.width), weights, *rest


def _encode_by_torch(points, scales, table, layout):
    from visdom_plugin.nerf.encoding.hash_torch import encode_torch

    return encode_torch(points, scales, table, layout)


def _encode_by_cpu(points, scales, table, layout, *more):
    from visdom_plugin.nerf.encoding.hash_cpu import encode_cpu

    return encode_cpu(points, scales, table, layout, *more)


def _encode_by_triton(points, scales, table, layout):
    from visdom_plugin.nerf.encoding.hash_triton import encode_triton

    return encode_triton(points, scales, table, layout)


BACKENDS = {"cpu": _encode_by_cpu, "triton": _encode_by_triton, "torch": _encode_by_torch}


@cache
def default_backend(device: torch.device) -> str:
    """ "cpu" on the CPU; elsewhere "triton" where it can be imported, else "torch"."""
    if device.type == "cpu":
        return "cpu"
    return "triton" if importlib.util.find_spec("triton") else "torch"


def _backend(name: str):
    if name not in BACKENDS:
        raise ConfigError(f"no hash grid backend {name!r}", todo=f"choose one of {', '.join(BACKENDS)}")
    return BACKENDS[name]
