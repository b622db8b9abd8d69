"""The sampler as torch operators, so that a compiler calls it whole instead of tracing into numba.

`torch.compile` neither breaks its graph there nor fails with `fullgraph=True`. Outside of compiled code nothing of
this is used, and the compiler is not imported.
"""

from __future__ import annotations

import itertools
from typing import Protocol
from weakref import WeakValueDictionary

import torch
from torch import Tensor

from visdom_plugin.hooks.protocols import SampleFilter, SamplerHook


class FilteringSampler(SamplerHook, SampleFilter, Protocol):
    """What the operators ask."""


_numbers = itertools.count()
_samplers: WeakValueDictionary[int, FilteringSampler] = WeakValueDictionary()
# Operators take tensors and numbers: a sampler goes by its number.
_library = torch.library.Library("visdom_plugin", "DEF")


def enter(sampler: FilteringSampler) -> int:
    """The number by which operators know this sampler, for as long as it lives in this process."""
    number = next(_numbers)
    _samplers[number] = sampler
    return number


def _ray_bounds(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, sampler: int
) -> tuple[Tensor, ...]:
    bounds = _samplers[sampler].bound(origins, directions, near, far)
    return tuple(x.clone() for x in bounds)  # an operator's results may not share memory


def _ray_bounds_shapes(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, sampler: int
) -> tuple[Tensor, ...]:
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    return *(directions.new_empty(shape) for _ in range(2)), directions.new_empty(shape, dtype=torch.bool)


def _keep(points: Tensor, sampler: int) -> Tensor:
    return _samplers[sampler].keep(points)


def _keep_shape(points: Tensor, sampler: int) -> Tensor:
    return points.new_empty(points.shape[:-1], dtype=torch.bool)


_library.define(
    "ray_bounds(Tensor origins, Tensor directions, Tensor near, Tensor far, int sampler)"
    " -> (Tensor, Tensor, Tensor)"
)
_library.impl("ray_bounds", _ray_bounds, "CompositeExplicitAutograd")
torch.library.register_fake("visdom_plugin::ray_bounds", _ray_bounds_shapes, lib=_library)
_library.define("keep(Tensor points, int sampler) -> Tensor")
_library.impl("keep", _keep, "CompositeExplicitAutograd")
torch.library.register_fake("visdom_plugin::keep", _keep_shape, lib=_library)
