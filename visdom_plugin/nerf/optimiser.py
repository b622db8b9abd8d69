"""Adam over the parameters of a radiance field, and its state as a flat dict of tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn


class FieldOptimiser:
    """One fused Adam over several groups of named parameters.

    Args:
        groups: pairs of named parameters and weight decay.
        betas, eps: Adam's.
        decoupled: whether weights decay beside the moments (AdamW), not by the gradient.
        clip: largest norm of all gradients together, to which longer ones are shortened; None for any.
    """

    def __init__(
        self,
        groups: Sequence[tuple[Mapping[str, nn.Parameter], float]],
        *,
        betas: tuple[float, float],
        eps: float,
        decoupled: bool = False,
        clip: float | None = None,
    ):
        self.clip = clip
        self.parameters = {name: p for named, _ in groups for name, p in named.items()}
        kind = torch.optim.AdamW if decoupled else torch.optim.Adam
        self.adam = kind(
            [{"params": list(named.values()), "weight_decay": decay} for named, decay in groups],
            lr=0.0,
            betas=betas,
            eps=eps,
            fused=True,
        )

    def step(self, learning_rate: float) -> None:
        """One step; gradients are dropped afterwards."""
        for group in self.adam.param_groups:
            group["lr"] = learning_rate
        if self.clip is not None:
            nn.utils.clip_grad_norm_(self.parameters.values(), self.clip)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts."""
        out = {}
        for name, parameter in self.parameters.items():
            out[name] = parameter.detach()
            for key, value in self.adam.state.get(parameter, {}).items():
                out[f"adam.{name}.{key}"] = torch.as_tensor(value)
        return out

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave."""
        for name, parameter in self.parameters.items():
            parameter.copy_(state[name])
            prefix = f"adam.{name}."
            moments = {k[len(prefix) :]: v.clone() for k, v in state.items() if k.startswith(prefix)}
            if moments:
                # The count of steps, too: fused Adam reads it on the device.
                self.adam.state[parameter] = {k: v.to(parameter.device) for k, v in moments.items()}


def warm_up_and_steps(
    step: int, total: int, *, base: float, warm_up: int, factor: float, at: Sequence[float]
) -> float:
    """A learning rate that rises linearly from a hundredth, then falls by `factor` at shares of the schedule."""
    rise = min(1.0, 0.01 + 0.99 * step / warm_up) if warm_up else 1.0
    return base * rise * factor ** sum(step >= share * total for share in at)


def warm_up_and_decay(
    step: int, total: int, *, first: float, last: float, warm_up: int, delay: float
) -> float:
    """A learning rate on a line in the logarithm from `first` to `last`, after a rise from `delay` times itself.

    mip-NeRF's: rise = delay + (1 - delay) sin(pi / 2 min(step / warm_up, 1)).
    """
    import math

    rise = delay + (1 - delay) * math.sin(0.5 * math.pi * min(step / warm_up, 1)) if warm_up else 1.0
    t = min(step / max(total, 1), 1)
    return rise * first ** (1 - t) * last**t
