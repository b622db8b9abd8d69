"""Colour correction of training views: what exposure and white balance did to each photograph.

Every training view has an affine map of colours, 3 x 4, fitted along with the scene as 3DGS compensates exposure
(Kerbl et al. 2024, "A hierarchical 3D Gaussian representation"). The maps differ from their mean alone, which is
the identity: novel views, which have no map, have the colours of the average photograph.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

LR, LR_FINAL = 0.01, 0.001
"""Learning rates of Adam at the first and the last step, on a line in the logarithm."""
_PREFIX = "colour_correction."


class ColourCorrection:
    """One map per training view.

    Args:
        views: their number.
        steps: of the whole training.
        device: where colours are.
    """

    def __init__(self, views: int, steps: int, device: torch.device):
        self.steps = steps
        self.offsets = torch.zeros(views, 3, 4, device=device).requires_grad_()
        self.adam = torch.optim.Adam([self.offsets], lr=LR, eps=1e-15)

    @property
    def maps(self) -> Tensor:
        """(views, 3, 4) from rgb and 1 to rgb; their mean is the identity."""
        identity = torch.eye(3, 4, device=self.offsets.device)
        return identity + self.offsets - self.offsets.mean(0)

    def apply(self, rgb: Tensor, alpha: Tensor, background: Tensor, view: Tensor | int) -> Tensor:
        """Colours (..., 3) as the camera of a view would have taken them; the background stays as it is.

        Args:
            rgb: (..., 3) rendered over the background.
            alpha: (...) opacity.
            background: (3,) or (..., 3).
            view: (...) int64 training views, or one for all.
        """
        behind = (1 - alpha[..., None]) * background
        own = torch.cat([rgb - behind, alpha[..., None]], -1)
        maps = self.maps[view]
        return torch.einsum("...ij,...j->...i", maps, own) + behind

    def step(self, step: int) -> None:
        """A step of the maps; gradients are dropped afterwards."""
        share = min(step / max(self.steps, 1), 1)
        self.adam.param_groups[0]["lr"] = LR ** (1 - share) * LR_FINAL**share
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Tensor]:
        """Maps, moments and step count as a flat dict of tensors."""
        state = self.adam.state.get(self.offsets, {})
        values = {"offsets": self.offsets.detach(), **{k: torch.as_tensor(v) for k, v in state.items()}}
        return {_PREFIX + name: value for name, value in values.items()}

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; other entries are passed over."""
        own = {k.removeprefix(_PREFIX): v.clone() for k, v in state.items() if k.startswith(_PREFIX)}
        self.offsets.copy_(own.pop("offsets"))
        if own:
            self.adam.state[self.offsets] = {
                k: v if k == "step" else v.to(self.offsets) for k, v in own.items()
            }


class CorrectsColours:
    """A method's part: the correction, where its config asks for one."""

    correction: ColourCorrection | None = None

    def correction_state(self) -> dict[str, Tensor]:
        """Its part of the method's state; empty without one."""
        return {} if self.correction is None else self.correction.state_dict()

    def load_correction(self, state: Mapping[str, Tensor]) -> None:
        """Takes over its part of a method's state."""
        if self.correction is not None:
            self.correction.load_state_dict(state)

    def step_correction(self, step: int) -> None:
        """Its optimiser's step, after the backward pass."""
        if self.correction is not None:
            self.correction.step(step)
