"""Gaussian parameters with their Adam state: the one place that adds, removes and resets both together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.splat import adam

BETAS = 0.9, 0.999
EPSILON = 1e-15
"""3DGS's: gradients of single Gaussians are far below Adam's usual 1e-8."""
SLOW = 1 / 20
"""Of their learning rate, at which harmonics behind the constant learn (3DGS)."""


@dataclass
class Moments:
    """What Adam keeps of a parameter."""

    exp_avg: Tensor
    exp_avg_sq: Tensor
    steps: int = 0


class GaussianOptimiser:
    """Adam over named per-Gaussian parameters whose first dimension is the Gaussian.

    Harmonics "sh" (N, B, 3) learn at two rates: those behind the constant at a twentieth (3DGS). The state names
    the two parts sh_dc and sh_rest.

    Args:
        parameters: tensors (N, ...) by name.
        learning_rates: one per name.
    """

    parameters: dict[str, torch.nn.Parameter]
    """By name; a step changes them in place, and new ones are there after any other change."""

    def __init__(self, parameters: Mapping[str, Tensor], learning_rates: Mapping[str, float]):
        self.rates = {name: learning_rates[name] for name in parameters}
        self.parameters = {
            n: torch.nn.Parameter(p.detach().clone().contiguous()) for n, p in parameters.items()
        }
        self._moments: dict[str, Moments] = {}
        self._views: dict[str, tuple[int, list[np.ndarray]]] = {}

    def __len__(self) -> int:
        return next(iter(self.parameters.values())).shape[0]

    def set_learning_rate(self, name: str, value: float) -> None:
        self.rates[name] = value

    @torch.no_grad()
    def step(self) -> None:
        """One Adam step; gradients are dropped afterwards."""
        here: list[adam.Update] = []
        elsewhere: list[_Elsewhere] = []
        for name, parameter in self.parameters.items():
            if parameter.grad is None:
                continue
            if name not in self._moments:
                self._moments[name] = Moments(torch.zeros_like(parameter), torch.zeros_like(parameter))
            moments = self._moments[name]
            moments.steps += 1
            first, second = (1 - beta**moments.steps for beta in BETAS)
            gradient, rate, root = parameter.grad.contiguous(), self.rates[name] / first, math.sqrt(second)
            if parameter.device.type == "cpu" and parameter.dtype == torch.float32:
                p, m, v, shares = self._view(name)
                here.append(adam.Update(p, gradient.numpy().reshape(-1), m, v, shares, rate, root))
            else:
                tensors = parameter.detach(), gradient, moments.exp_avg, moments.exp_avg_sq
                elsewhere.append(_Elsewhere(*tensors, rate, root, slow=name == "sh"))
            parameter.grad = None
        adam.update(here, BETAS, EPSILON)
        update_by_torch(elsewhere)

    def _view(self, name: str) -> list[np.ndarray]:
        """A parameter and its moments as flat arrays, and its shares of the learning rate; made once a tensor."""
        parameter, moments = self.parameters[name], self._moments[name]
        place, arrays = self._views.get(name, (0, []))
        if place != parameter.data_ptr() or not arrays:
            row = math.prod(parameter.shape[1:])
            tensors = parameter.detach(), moments.exp_avg, moments.exp_avg_sq
            arrays = [t.view(-1).numpy() for t in tensors]
            arrays.append(adam.repeat(3 if name == "sh" else row, row, SLOW))
            self._views[name] = parameter.data_ptr(), arrays
        return arrays

    def keep(self, kept: Tensor) -> None:
        """Keeps the Gaussians where `kept` (N,) bool is True."""
        self._replace(lambda name, x: x[kept])

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Adds Gaussians at the end; their moments start at zero."""
        self._replace(
            lambda name, x: torch.cat([x, rows[name].to(x)]),
            lambda name, x: torch.cat([x, torch.zeros_like(rows[name]).to(x)]),
        )

    def overwrite(self, name: str, values: Tensor) -> None:
        """Replaces one parameter and forgets its moments."""
        self._replace(
            lambda n, x: values.to(x) if n == name else x,
            lambda n, x: torch.zeros_like(x) if n == name else x,
        )

    @torch.no_grad()
    def _replace(
        self,
        change: Callable[[str, Tensor], Tensor],
        change_moments: Callable[[str, Tensor], Tensor] | None = None,
    ) -> None:
        change_moments = change_moments or change
        self._views.clear()
        for name, old in self.parameters.items():
            self.parameters[name] = torch.nn.Parameter(change(name, old.detach()).contiguous())
        for name, m in self._moments.items():
            m.exp_avg, m.exp_avg_sq = (
                change_moments(name, x).contiguous() for x in (m.exp_avg, m.exp_avg_sq)
            )

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts as a flat dict of tensors."""
        out = _split({name: p.detach() for name, p in self.parameters.items()})
        for key in ("exp_avg", "exp_avg_sq"):
            moments = _split({name: getattr(m, key) for name, m in self._moments.items()})
            out |= {f"adam.{name}.{key}": value for name, value in moments.items()}
        for name, m in self._moments.items():
            for part in ("sh_dc", "sh_rest") if name == "sh" else (name,):
                out[f"adam.{part}.step"] = torch.tensor(float(m.steps))
        return out

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        self._views.clear()
        for name, old in self.parameters.items():

            def read(text: str, name: str = name, like: Tensor = old) -> Tensor:
                parts = ("sh_dc", "sh_rest") if name == "sh" else (name,)
                return torch.cat(
                    [state[text.format(part)].to(like) for part in parts], 1 if len(parts) > 1 else 0
                )

            self.parameters[name] = torch.nn.Parameter(read("{}"))
            self._moments.pop(name, None)
            steps = state.get(f"adam.{'sh_dc' if name == 'sh' else name}.step")
            if steps is not None:
                self._moments[name] = Moments(read("adam.{}.exp_avg"), read("adam.{}.exp_avg_sq"), int(steps))


class _Elsewhere(NamedTuple):
    """`adam.Update` on any device."""

    parameter: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    rate: float
    root: float
    slow: bool
    """Harmonics (N, B, 3)."""


def update_by_torch(updates: Sequence[_Elsewhere]) -> None:
    """`adam.update` on any device: on a GPU an operation launches one kernel for all parameters."""
    if not updates:
        return
    parameters, gradients, means, squares, rates, roots, slow = (list(x) for x in zip(*updates, strict=True))
    torch._foreach_lerp_(means, gradients, 1 - BETAS[0])
    torch._foreach_mul_(squares, BETAS[1])
    torch._foreach_addcmul_(squares, gradients, gradients, 1 - BETAS[1])
    divisors = torch._foreach_sqrt(squares)
    torch._foreach_div_(divisors, roots)
    torch._foreach_add_(divisors, EPSILON)
    changes = torch._foreach_mul(means, rates)
    torch._foreach_div_(changes, divisors)
    for change, harmonics in zip(changes, slow, strict=True):
        if harmonics:
            change[:, 1:] *= SLOW
    torch._foreach_sub_(parameters, changes)


def _split(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors (N, ...) by name, as the state names them."""
    parts = dict(tensors)
    if "sh" in parts:
        sh = parts.pop("sh")
        parts |= {"sh_dc": sh[:, :1], "sh_rest": sh[:, 1:]}
    return parts
