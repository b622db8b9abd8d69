"""Adam over the parameters of a radiance field, and its state as a flat dict of tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from visdom_plugin.nerf import adam

SMALL = 1 << 14
"""Numbers of a tensor below which it is a part of a larger one: Adam has a price for every tensor."""


class FieldOptimiser:
    """One Adam over several groups of named parameters: a kernel on the CPU, torch's fused one elsewhere.

    Small parameters of a group become views of one tensor, which is what Adam sees; one without a gradient counts
    as one whose gradient is 0.

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
        self.betas, self.epsilon, self.decoupled, self.clip = betas, eps, decoupled, clip
        self.parameters = {name: p for named, _ in groups for name, p in named.items()}
        self._joint: list[tuple[nn.Parameter, list[nn.Parameter]]] = []
        kind = torch.optim.AdamW if decoupled else torch.optim.Adam
        self.adam = kind(
            [{"params": self._join(list(named.values())), "weight_decay": decay} for named, decay in groups],
            lr=0.0,
            betas=betas,
            eps=eps,
            fused=True,
        )

    def _join(self, parameters: list[nn.Parameter]) -> list[nn.Parameter]:
        """What Adam is handed for the parameters of a group."""
        small = [p for p in parameters if p.numel() < SMALL]
        if len(small) < 2:
            return parameters
        joint = nn.Parameter(torch.cat([p.detach().reshape(-1) for p in small]))
        for p, part in zip(small, _parts(joint.detach(), small), strict=True):
            p.data = part
        self._joint.append((joint, small))
        return [*(p for p in parameters if p.numel() >= SMALL), joint]

    def step(self, learning_rate: float) -> None:
        """One step; gradients are dropped afterwards."""
        for group in self.adam.param_groups:
            group["lr"] = learning_rate
        if self.clip is not None:
            nn.utils.clip_grad_norm_(self.parameters.values(), self.clip)
        for joint, small in self._joint:
            gradients = (torch.zeros_like(p) if p.grad is None else p.grad for p in small)
            joint.grad = torch.cat([g.reshape(-1) for g in gradients])
        if all(p.device.type == "cpu" and p.dtype == torch.float32 for p in self.parameters.values()):
            self._step_by_kernel()
        else:
            self.adam.step()
        self.drop_gradients()

    @torch.no_grad()
    def _step_by_kernel(self) -> None:
        """`adam.step()`, with its state."""
        updates = []
        for group in self.adam.param_groups:
            rate, decay = group["lr"], group["weight_decay"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.adam.state[p]
                if not state:
                    state |= {k: torch.zeros_like(p) for k in ("exp_avg", "exp_avg_sq")}
                    state["step"] = torch.zeros(())
                state["step"] += 1
                first, second = (1 - beta ** float(state["step"]) for beta in self.betas)
                tensors = p, p.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"]
                of, gradient, mean, square = (x.detach().view(-1).numpy() for x in tensors)
                decays = (0.0, 1 - rate * decay) if self.decoupled else (decay, 1.0)
                updates.append(
                    adam.Update(of, gradient, mean, square, rate / first, math.sqrt(second), *decays)
                )
        adam.update_all(updates, self.betas, self.epsilon)

    def drop_gradients(self) -> None:
        """Leaves no gradient for the next step to add to."""
        for parameter in self.parameters.values():
            parameter.grad = None

    def _moments(self) -> dict[nn.Parameter, dict[str, Tensor]]:
        """Adam's moments and step count by parameter, the moments as views."""
        found: dict[nn.Parameter, dict[str, Tensor]] = {
            p: dict(self.adam.state.get(p, {})) for p in self.parameters.values()
        }
        for joint, small in self._joint:
            for key, value in self.adam.state.get(joint, {}).items():
                values = [value.clone() for _ in small] if key == "step" else _parts(value, small)
                for p, part in zip(small, values, strict=True):
                    found[p][key] = part
        return found

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts."""
        moments, out = self._moments(), {}
        for name, parameter in self.parameters.items():
            out[name] = parameter.detach()
            for key, value in moments[parameter].items():
                out[f"adam.{name}.{key}"] = torch.as_tensor(value)
        return out

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave."""
        moments: dict[nn.Parameter, dict[str, Tensor]] = {}
        for name, parameter in self.parameters.items():
            parameter.copy_(state[name])
            prefix = f"adam.{name}."
            # The count of steps, too: fused Adam reads it on the device.
            moments[parameter] = {
                k[len(prefix) :]: v.to(parameter.device, copy=True)
                for k, v in state.items()
                if k.startswith(prefix)
            }
        for joint, small in self._joint:
            each = [moments.pop(p) for p in small]
            moments[joint] = {
                key: value if key == "step" else torch.cat([m[key].reshape(-1) for m in each])
                for key, value in each[0].items()
            }
        self.adam.state.update({p: found for p, found in moments.items() if found})


def _parts(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Views of a flat tensor in the shapes of others, one after the other."""
    return [part.view_as(p) for part, p in zip(flat.split([p.numel() for p in like]), like, strict=True)]


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
    rise = delay + (1 - delay) * math.sin(0.5 * math.pi * min(step / warm_up, 1)) if warm_up else 1.0
    t = min(step / max(total, 1), 1)
    return rise * first ** (1 - t) * last**t
