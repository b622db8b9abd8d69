"""The calls a trainer makes of a method, and the values that pass between them: batches and a step's output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.render import Render
from visdom_plugin.scene import Views


@dataclass(frozen=True)
class ViewBatch:
    """One whole training view."""

    index: int
    camera: Cameras
    """One camera, shape ()."""
    image: Tensor
    """(H, W, 3) float32 in [0, 1], background as photographed."""
    mask: Tensor
    """(H, W) float32, 1 on the object."""
    mono_depth: Tensor | None
    """(H, W) float32 in its own unit."""
    weight: Tensor | None = None
    """(H, W) float32, 0 at pixels that take part in no loss, else 1; None when all of them do."""
    mask_known: bool = True
    """False for a view that is good for colour only: its mask says nothing."""


@dataclass(frozen=True)
class PixelBatch:
    """Pixels drawn evenly over all training views, ignored ones left out."""

    origins: Tensor
    """(n, 3) float32, in the frame of the views."""
    directions: Tensor
    """(n, 3) float32 unit, through the pixels' centres."""
    rgb: Tensor
    """(n, 3) float32 in [0, 1]."""
    mask: Tensor
    """(n,) float32, 1 on the object."""
    radii: Tensor
    """(n,) float32 radius of each pixel's cone at distance 1."""
    mask_known: Tensor | None = None
    """(n,) bool, False at pixels of views that are good for colour only; None when all masks are known."""
    pixels: Tensor | None = None
    """(n,) int64 numbers of the pixels among those of all training views, view by view and row by row; None for
    rays of anything else."""


@dataclass(frozen=True)
class StepOutput:
    """The forward pass of one training step."""

    losses: Mapping[str, Tensor]
    """Named, weighted, finite scalars; the trainer differentiates their sum."""
    metrics: Mapping[str, Tensor] = field(default_factory=dict)
    """Named scalars without gradient, on the method's device: the trainer reads them when it writes a line of the
    log, so that no step waits for the device. "psnr", in dB, is shown while training goes on."""
    renders: Sequence[Render] = ()
    """The training view as drawn, for methods whose `optimise` measures it after the backward pass, as
    densification does; the trainer only hands them on."""

    @property
    def total(self) -> Tensor:
        """The sum of the losses, a scalar."""
        return reduce(torch.add, self.losses.values())


Batch: TypeAlias = Any
"""A `ViewBatch`, or a `PixelBatch`: a method takes one of the two."""
Hook: TypeAlias = Any
"""A `SamplerHook` or a `GaussianHook`: a method takes one of the two."""


class Method(Protocol):
    """A reconstruction method. Constructed as `Method(config)`, where `config` is its plain dataclass.

    Randomness comes from (seed, step) alone, never from a global generator: a step repeated after a resume
    draws the same numbers. `visdom_plugin.seeding.generator(seed, "what for", step)` makes such numbers.

    A method with a `pixels_per_step(step) -> int` is handed that many pixels of all views per step
    (`PixelBatch`), any other one a whole view (`ViewBatch`). The number may depend on the method's state, which
    then is part of `state_dict`. Of the others, one with a `view_at(step) -> int | None` says which training view
    that is, by its number; None leaves it to the trainer, which goes through all of them in turn.

    A config with a `check_requirements()` is asked before anything else whether all is there that training needs
    from outside, such as packages and weights; it raises a PluginError that says what is missing.

    A method with a `summary() -> dict[str, int]` has these numbers, {"gaussians": 6000}, shown while it trains
    and noted in run.json's `model`. One with an `events() -> dict[str, list[int]]`, such as {"opacities reset":
    [120, 240]}, has these steps, counted from 1, marked in the training curve; run.json has them as `events`.

    Fields of the config that have a meaning here: `mask_weight`, the weight of the silhouette loss; `hull`, what
    to carve; `vd`, the hook's settings. `visdom_plugin.specs.MethodSpec` adds them where a config lacks them.
    Everything about the visible domain comes in by `hooks`; `visdom_plugin.hooks.protocols` says what a method
    does with them. Without hooks, neither `vd` nor a hull that the bare method did not ask for changes anything.

    `pytest --pyargs visdom_plugin.conformance --method NAME` checks what is written here.
    """

    total_steps: int
    """Length of the schedule, 1 or more; the trainer calls steps 0 .. total_steps - 1."""

    def setup(
        self, views: Views, hooks: Sequence[Hook], *, hull: Hull | None, device: torch.device, seed: int
    ) -> None:
        """Builds parameters and optimisers on `device` from the training views.

        Views, hooks, hull, batches and cameras are in one frame, whose coordinates float32 can hold. Where the
        capture's own is too far from its origin for that, `views.origin` tells where the frame lies in it.

        `hull` is the one the config asked for, or None when the config has no `hull` field. `hooks` is empty
        for the variants without VisDom, and when the hook is switched off.
        """
        ...

    def train_step(self, batch: Batch, step: int) -> StepOutput:
        """The forward pass.

        The batch, a `ViewBatch` or `PixelBatch`, belongs to the trainer and stays as it is.
        """
        ...

    def optimise(self, step: int, output: StepOutput) -> None:
        """After the backward pass: optimiser steps, schedules, densification, hooks' `after_step`.

        `output` is what `train_step` returned for this step, its losses differentiated. Nothing else that the
        forward pass leaves behind may be needed here.
        """
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
        """Writes the reconstruction into the folder, in standard formats; returns files.

        They are in the capture's own frame, `views.origin` away from the method's.
        """
        ...
