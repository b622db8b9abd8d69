"""A second device without hardware: its tensors lie in the CPU's memory, but say that they are elsewhere.

It runs what a method does on any device but the CPU, and refuses what CUDA refuses: an operation on tensors of two
devices, an array of a tensor that is elsewhere, a generator of another device. It needs torch 2.9 or newer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

NAME = "elsewhere"
CPU = torch.device("cpu")
TAKES_BOTH = (
    "aten::copy_",
    "aten::_to_copy",
    # Their indices may lie on the CPU, also on CUDA.
    "aten::index",
    "aten::index_put",
    "aten::index_put_",
    "aten::_index_put_impl_",
)
"""Operations whose tensors may be on two devices."""


class Elsewhere(Tensor):
    """A tensor on the second device. Its values are those of `raw`, on the CPU."""

    raw: Tensor

    @staticmethod
    def __new__(cls, raw: Tensor) -> Elsewhere:
        self = Tensor._make_wrapper_subclass(
            cls, raw.shape, raw.stride(), raw.storage_offset(), dtype=raw.dtype, device=device()
        )
        self.raw = raw
        return self

    @classmethod
    def __torch_dispatch__(cls, op, types, args=(), kwargs=None):
        return _run(op, args, kwargs or {})

    def __repr__(self, *, tensor_contents=None) -> str:
        return f"Elsewhere({self.raw})"


class _Everywhere(TorchDispatchMode):
    """Also hands over what makes a tensor on the second device of none that is there."""

    def __torch_dispatch__(self, op, types, args=(), kwargs=None):
        return _run(op, args, kwargs or {})


def supported() -> bool:
    from torch.utils import backend_registration

    return hasattr(backend_registration, "_setup_privateuseone_for_python_backend")


@cache
def device() -> torch.device:
    """The second device; made known to torch on the first call."""
    from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

    _setup_privateuseone_for_python_backend(NAME)
    return torch.device(NAME, 0)


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Within, tensors can be made on the device, and moved to it."""
    before = torch._C._only_lift_cpu_tensors()
    # So that torch.tensor(..., device=...) asks for the move, too, as FakeTensorMode has it.
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _Everywhere():
            yield device()
    finally:
        torch._C._set_only_lift_cpu_tensors(before)


def _run(op, args, kwargs):
    """The operation on the CPU, its results where the operands, or the device asked for, are."""
    flat, spec = tree_flatten((args, kwargs))
    given, others, wanted, draws = {}, [], None, None
    for i, x in enumerate(flat):
        if isinstance(x, Elsewhere):
            given[id(x.raw)], flat[i] = x, x.raw
        elif isinstance(x, Tensor):
            others.append(x)
        elif isinstance(x, torch.device):
            wanted, flat[i] = x, CPU
        elif isinstance(x, torch.Generator):
            draws = x
    name = op._schema.name
    astray = [tuple(x.shape) for x in others if x.dim()]
    if given and astray and name not in TAKES_BOTH:
        raise RuntimeError(f"{name}: tensors of shapes {astray} are on the CPU, others are not")
    elsewhere = bool(given) if wanted is None else wanted.type == NAME
    if elsewhere and draws is not None:
        raise RuntimeError(f"{name}: the generator is on the CPU, the tensor is not")
    args_there, kwargs_there = tree_unflatten(flat, spec)
    with _disable_current_modes():
        out = op(*args_there, **kwargs_there)
    if name == "aten::copy_":
        return args[0]

    def place(x):
        if not isinstance(x, Tensor) or any(x is other for other in others):
            return x
        if not elsewhere:
            return x
        same = given.get(id(x))
        return Elsewhere(x) if same is None else same

    return tree_map(place, out)
