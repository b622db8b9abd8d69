"""What a trainer asks of a method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from visdom_plugin.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.scene import Views


class Method(Protocol):
    """A reconstruction method. Constructed as `Method(config)`, where `config` is its plain dataclass.

    Randomness comes from (seed, step) alone, never from a global generator: a step repeated after a resume
    draws the same numbers.

    A method with a `pixels_per_step(step) -> int` is handed that many pixels of all views per step, any other one
    a whole view. The number may depend on the method's state, which then is part of `state_dict`.
    """

    total_steps: int
    """Length of the schedule; the trainer calls steps 0 .. total_steps - 1."""

    def setup(
        self, views: Views, hooks: Sequence[Any], *, hull: Any, device: torch.device, seed: int
    ) -> None:
        """Builds parameters and optimisers from the training views.

        `hull` is the one the config asked for, or None when the config has no `hull` field. `hooks` is empty
        for the variants without VisDom.
        """
        ...

    def train_step(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Forward pass: named, weighted scalar losses whose sum the trainer differentiates."""
        ...

    def optimise(self, step: int) -> None:
        """After the backward pass: optimiser steps, schedules, densification, hooks' `after_step`."""
        ...

    def render(self, camera: Cameras, background: Tensor) -> Render:
        """One view without gradients, on a background colour (3,)."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything a resumed run needs, optimiser state included: a flat dict of tensors."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes over a state saved by the same config; called after `setup`."""
        ...

    def export(self, folder: Path) -> list[Path]:
        """Writes the reconstruction in standard formats, in the input frame; returns the files."""
        ...
