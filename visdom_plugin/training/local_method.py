"""Methods work in a frame near their scene: the views are moved there, and the world's cameras on their way in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from visdom_plugin.errors import CheckpointError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.local_frame import local_origin
from visdom_plugin.hull.hull import Hull
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import Batch, Hook, Method, StepOutput

ORIGIN = "frame.origin"
"""Key of the frame's origin in a checkpoint; not there where the frame is the world's own."""


def move_near(views: Views) -> Views:
    """The training views in the frame the method works in: the capture's own, unless its origin is far away."""
    return views.relative_to(local_origin(views.cameras))


class LocalMethod:
    """A method that was set up on `move_near(views)`, for who knows the world's frame alone."""

    def __init__(self, method: Method, origin: Tensor):
        self.method, self.origin = method, origin
        self.total_steps = method.total_steps

    def __getattr__(self, name: str) -> Any:
        """What methods offer besides, such as `pixels_per_step`."""
        return getattr(self.__dict__["method"], name)

    def setup(
        self, views: Views, hooks: Sequence[Hook], *, hull: Hull | None, device: torch.device, seed: int
    ) -> None:
        self.method.setup(views, hooks, hull=hull, device=device, seed=seed)

    def train_step(self, batch: Batch, step: int) -> StepOutput:
        return self.method.train_step(batch, step)

    def optimise(self, step: int, output: StepOutput) -> None:
        self.method.optimise(step, output)

    def render(self, camera: Cameras, background: Tensor) -> Render:
        return self.method.render(camera.relative_to(self.origin), background)

    def state_dict(self) -> dict[str, Tensor]:
        return self.method.state_dict() | {ORIGIN: self.origin}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        state = dict(state)
        origin = state.pop(ORIGIN, torch.zeros(3, dtype=torch.float64))
        if not torch.equal(origin, self.origin):
            raise CheckpointError(
                f"the checkpoint's frame has its origin at {origin.tolist()}, not at {self.origin.tolist()}",
                cause="a run of an earlier version, which trained in float32 far from the origin",
                todo="train again",
            )
        self.method.load_state_dict(state)

    def export(self, folder: Path) -> list[Path]:
        return self.method.export(folder)
