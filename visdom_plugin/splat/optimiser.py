"""Gaussian parameters with their Adam state: the one place that adds, removes and resets both together."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


class GaussianOptimiser:
    """One Adam over named per-Gaussian parameters whose first dimension is the Gaussian.

    Harmonics "sh" (N, B, 3) learn at two rates: those behind the constant at a twentieth (3DGS). Adam has one rate
    for a tensor, so it holds them, and the state names them, as sh_dc and sh_rest.

    Args:
        parameters: tensors (N, ...) by name.
        learning_rates: one per name.
    """

    parameters: dict[str, torch.nn.Parameter]
    """By name; new ones after every call that changes them."""

    def __init__(self, parameters: Mapping[str, Tensor], learning_rates: Mapping[str, float]):
        rates = dict(learning_rates)
        if "sh" in rates:
            rates |= {"sh_dc": rates["sh"], "sh_rest": rates["sh"] / 20}
        groups = [
            {"params": [torch.nn.Parameter(p.detach().clone().contiguous())], "lr": rates[name], "name": name}
            for name, p in _split(parameters).items()
        ]
        # 3DGS's epsilon: gradients of single Gaussians are far below Adam's default 1e-8.
        self.adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
        self._join()

    def __len__(self) -> int:
        return next(iter(self.parameters.values())).shape[0]

    def set_learning_rate(self, name: str, value: float) -> None:
        for group in self.adam.param_groups:
            if group["name"] == name:
                group["lr"] = value

    def step(self) -> None:
        """One Adam step; gradients are dropped afterwards."""
        gradients = _split({n: p.grad for n, p in self.parameters.items() if p.grad is not None})
        for group in self.adam.param_groups:
            gradient = gradients.get(group["name"])
            group["params"][0].grad = None if gradient is None else gradient.contiguous()
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        self._join()

    def keep(self, kept: Tensor) -> None:
        """Keeps the Gaussians where `kept` (N,) bool is True."""
        self._replace(lambda name, x: x[kept])

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Adds Gaussians at the end; their moments start at zero."""
        rows = _split(rows)
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

    def _replace(self, change, change_moments=None) -> None:
        change_moments = change_moments or change
        for group in self.adam.param_groups:
            name, old = group["name"], group["params"][0]
            new = torch.nn.Parameter(change(name, old.detach()).contiguous())
            state = self.adam.state.pop(old, None)
            if state:
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key] = change_moments(name, state[key]).contiguous()
                self.adam.state[new] = state
            group["params"] = [new]
        self._join()

    def _join(self) -> None:
        parts = {group["name"]: group["params"][0] for group in self.adam.param_groups}
        if "sh_dc" in parts:
            joined = torch.cat([parts.pop("sh_dc").detach(), parts.pop("sh_rest").detach()], 1)
            parts["sh"] = torch.nn.Parameter(joined)
        self.parameters = parts

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts as a flat dict of tensors."""
        out = {}
        for group in self.adam.param_groups:
            name, parameter = group["name"], group["params"][0]
            out[name] = parameter.detach()
            for key, value in self.adam.state.get(parameter, {}).items():
                out[f"adam.{name}.{key}"] = torch.as_tensor(value)
        return out

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        for group in self.adam.param_groups:
            name = group["name"]
            self.adam.state.pop(group["params"][0], None)
            new = torch.nn.Parameter(state[name].to(group["params"][0]).clone())
            group["params"] = [new]
            prefix = f"adam.{name}."
            moments = {k[len(prefix) :]: v.clone() for k, v in state.items() if k.startswith(prefix)}
            if moments:
                # The count of steps, too: fused Adam reads it on the device.
                self.adam.state[new] = {k: v.to(new.device) for k, v in moments.items()}
        self._join()


def _split(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors (N, ...) by name, as Adam holds them."""
    parts = dict(tensors)
    if "sh" in parts:
        sh = parts.pop("sh")
        parts |= {"sh_dc": sh[:, :1], "sh_rest": sh[:, 1:]}
    return parts
