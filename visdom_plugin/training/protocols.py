"""What a trainer asks of a method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.scene import Views


class Method(Protocol):
    """A reconstruction method. Constructed as `Method(config)`, where `config` is its plain dataclass.

    Randomness comes from (seed, step) alone, never from a global generator: a step repeated after a resume
    draws the same numbers. `visdom_plugin.seeding.generator(seed, "what for", step)` makes such numbers.

    A method with a `pixels_per_step(step) -> int` is handed that many pixels of all views per step
    (`visdom_plugin.training.batches.PixelBatch`), any other one a whole view (`ViewBatch`). The number may depend
    on the method's state, which then is part of `state_dict`.

    Fields of the config that have a meaning here: `mask_weight`, the weight of the silhouette loss; `hull`, what
    to carve; `vd`, the hook's settings. `visdom_plugin.specs.MethodSpec` adds them where a config lacks them.
    Everything about the visible domain comes in by `hooks`; `visdom_plugin.hooks.protocols` says what a method
    does with them. Without hooks, neither `vd` nor a hull that the bare method did not ask for changes anything.

    `pytest --pyargs visdom_plugin.conformance --method NAME` checks what is written here.
    """

    total_steps: int
    """Length of the schedule, 1 or more; the trainer calls steps 0 .. total_steps - 1."""

    def setup(
        self, views: Views, hooks: Sequence[Any], *, hull: Any, device: torch.device, seed: int
    ) -> None:
        """Builds parameters and optimisers on `device` from the training views.

        `hull` is the one the config asked for, or None when the config has no `hull` field. `hooks` is empty
        for the variants without VisDom, and when the hook is switched off.
        """
        ...

    def train_step(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Forward pass: named, weighted, finite scalar losses whose sum the trainer differentiates.

        The batch belongs to the trainer and stays as it is.
        """
        ...

    def optimise(self, step: int) -> None:
        """After the backward pass: optimiser steps, schedules, densification, hooks' `after_step`."""
        ...

    def render(self, camera: Cameras, background: Tensor) -> Render:
        """One view without gradients, on a background colour (3,), at any time after `setup`.

        Camera and background are on the method's device, in float32 or float64. The method stays as it is: how
        often it is rendered in between leaves no trace in training. Rays are bounded by hooks only where
        `config.vd.hull_at_inference` says so.
        """
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything a resumed run needs, optimiser state included: a flat dict of tensors."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes over a state saved by the same config; called after `setup`, with tensors on the CPU.

        What follows is bit for bit what would have followed there (on the CPU).
        """
        ...

    def export(self, folder: Path) -> list[Path]:
        """Writes the reconstruction into the folder, in standard formats and the input frame; returns files."""
        ...
