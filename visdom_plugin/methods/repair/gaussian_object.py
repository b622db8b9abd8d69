"""GaussianObject (Yang et al. 2024): coarse Gaussians, leave-one-out runs, fine-tuned networks, repair.

The four stages are one schedule of steps. Hooks take part in the coarse stage and the leave-one-out runs,
and in the repair where `repair.domain` says so.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from visdom_plugin.errors import CheckpointError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.repair import weights
from visdom_plugin.methods.repair.configs import GaussianObjectConfig
from visdom_plugin.methods.repair.diffusion import Networks
from visdom_plugin.methods.repair.finetuning import FineTuning
from visdom_plugin.methods.repair.leave_one_out import LeaveOneOut, State
from visdom_plugin.methods.repair.lora import LowRankUpdates
from visdom_plugin.methods.repair.repair import GoingOn, Repair, stage_config
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training.protocols import StepOutput, ViewBatch

NAMES = ("coarse", "leave-one-out", "fine-tuning", "repair")
ASSUMED_VIEWS = 4
"""Of which the length of the schedule is told before the views are known."""

log = logging.getLogger(__name__)


class Stage(Protocol):
    """Part of the schedule; steps are counted from its start."""

    steps: int

    def view_at(self, step: int) -> int | None: ...
    def train_step(self, batch: ViewBatch, step: int) -> StepOutput: ...
    def optimise(self, step: int, output: StepOutput) -> None: ...
    def state_dict(self) -> State: ...
    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None: ...


class Coarse:
    """The first stage: `3dgs-go`, bit for bit."""

    def __init__(self, run: GsGo):
        self.run, self.steps = run, run.total_steps

    def view_at(self, step: int) -> int | None:
        """Any, in turn."""
        return None

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        return self.run.train_step(batch, step)

    def optimise(self, step: int, output: StepOutput) -> None:
        self.run.optimise(step, output)

    def state_dict(self) -> State:
        return self.run.state_dict()

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        self.run.load_state_dict(dict(state))


class GaussianObject:
    """See `visdom_plugin.training.protocols.Method` for what each call does.

    Its state is the number of steps done, what finished stages left to the later ones, and the stage it is
    in.
    """

    def __init__(self, config: GaussianObjectConfig):
        self.config = config
        self.total_steps = sum(self._lengths(ASSUMED_VIEWS))

    def setup(
        self,
        views: Views,
        hooks: Sequence[GaussianHook],
        *,
        hull: Hull | None,
        device: torch.device,
        seed: int,
    ) -> None:
        if len(views) < 2:
            raise SceneError(
                f"GaussianObject leaves out one training view at a time, and there is {len(views)}",
                todo="give --views 2 or more",
            )
        self.views, self.hooks, self.hull, self.device, self.seed = views, list(hooks), hull, device, seed
        self.lengths = self._lengths(len(views))
        self.total_steps = sum(self.lengths)
        self.coarse = self._set_up(GsGo, self.config, self.hooks, seed)
        self.left: State = {}
        """What finished stages left to the later ones."""
        self.done, self.number = 0, 0
        self.stage: Stage = Coarse(self.coarse)

    def view_at(self, step: int) -> int | None:
        """The training view of a step; None where it is any, in turn."""
        return self.stage.view_at(step - self._start())

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        return self.stage.train_step(batch, step - self._start())

    def optimise(self, step: int, output: StepOutput) -> None:
        self.stage.optimise(step - self._start(), output)
        self.done = step + 1
        if self.number + 1 < len(NAMES) and self.done == self._start() + self.stage.steps:
            self._finish_stage()
            self.number += 1
            self.stage = self._begin()
        elif isinstance(self.stage, Repair) and self.done - self._start() == self.config.repair.until:
            # The networks have done their part.
            self.left, self.stage.targets = {}, {}

    def render(self, camera: Cameras, background: Tensor) -> Render:
        return self._shown().render(camera, background)

    def state_dict(self) -> State:
        found = {"steps_done": torch.tensor(self.done)}
        found |= {f"left.{k}": v for k, v in self.left.items()}
        return found | {f"stage.{k}": v for k, v in self.stage.state_dict().items()}

    def load_state_dict(self, state: State) -> None:
        def part(prefix: str) -> State:
            return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}

        self.done = int(state["steps_done"])
        self.number, self.left = self._stage_of(self.done), part("left.")
        if self.number:
            self._take_coarse(self.coarse)
        self.stage = self._begin()
        self.stage.load_state_dict(part("stage."), self.done - self._start())

    def summary(self) -> dict[str, int]:
        """What is shown of the model while it trains, and noted in run.json."""
        return self._shown().summary() | {"stage": self.number + 1}

    def events(self) -> dict[str, list[int]]:
        """What changes in the coarse stage, see `Strategy.events`, and where the later stages begin."""
        starts = {f"{name} begins": [sum(self.lengths[:i])] for i, name in enumerate(NAMES) if i}
        return self.coarse.events() | starts

    def export(self, folder: Path) -> list[Path]:
        return self._shown().export(folder)

    def _lengths(self, views: int) -> tuple[int, ...]:
        c = self.config
        loo = views * (2 * c.loo.steps - c.loo.view_returns)
        return c.steps, loo, c.lora.steps, c.repair.steps

    def _start(self) -> int:
        """The first step of the stage."""
        return sum(self.lengths[: self.number])

    def _stage_of(self, done: int) -> int:
        ends = [sum(self.lengths[: i + 1]) for i in range(len(NAMES))]
        return min(sum(done >= end for end in ends), len(NAMES) - 1)

    def _shown(self) -> GsGo:
        return self.stage.run if isinstance(self.stage, Repair) else self.coarse

    def _finish_stage(self) -> None:
        if isinstance(self.stage, Coarse):
            state = self.coarse.state_dict()
            self.left = {f"coarse.{k}": v.clone() for k, v in state.items() if _lasts(k)}
        elif isinstance(self.stage, LeaveOneOut):
            self.left |= self.stage.result()
        elif isinstance(self.stage, FineTuning):
            kept = {k: v for k, v in self.left.items() if k.startswith(("coarse.", "networks."))}
            self.left = kept | {f"lora.{k}": v for k, v in self.stage.result().items()}

    def _begin(self) -> Stage:
        """The stage whose turn it is."""
        log.info("stage %d of %d: %s", self.number + 1, len(NAMES), NAMES[self.number])
        cameras = self.views.cameras
        if self.number == 0:
            return Coarse(self.coarse)
        if self.number == 1:

            def make_run(config: GaussianObjectConfig, hooks: Sequence[GaussianHook], seed: int) -> GsGo:
                return self._set_up(GsGo, config, hooks, seed)

            return LeaveOneOut(self.config, cameras, self.hooks, make_run, self.seed)
        if self.number == 2:
            kept = {k: v for k, v in self.left.items() if k.startswith(("renders.", "noise."))}
            return FineTuning(self.config, self.coarse, kept, self._load_networks, self.seed)
        hooks = self.hooks if self.config.repair.domain else []
        run = self._set_up(GoingOn, stage_config(self.config), hooks, self.seed)
        self._take_coarse(run)
        return Repair(self.config, run, cameras, self._load_tuned, self.seed)

    def _set_up(
        self, kind: type[GsGo], config: GaussianObjectConfig, hooks: Sequence[GaussianHook], seed: int
    ) -> GsGo:
        run = kind(config)
        run.setup(self.views, hooks, hull=self.hull, device=self.device, seed=seed)
        return run

    def _take_coarse(self, run: GsGo) -> None:
        """Puts the coarse Gaussians, of which nothing has been measured yet, into a run; none where none
        are left."""
        state = {k.removeprefix("coarse."): v for k, v in self.left.items() if k.startswith("coarse.")}
        if state:
            nothing = torch.zeros(len(state["means"]))
            run.load_state_dict(
                state | {f"stats.{name}": nothing for name in ("gradient", "count", "radius_px")}
            )

    def _load_networks(self) -> Networks:
        """Reads the networks, the same as before where the run goes on.

        Raises:
            CheckpointError: they are others.
        """
        files = weights.check(self.config.weights, self.config.image_size)
        digest = torch.frombuffer(bytearray.fromhex(files.digest()), dtype=torch.uint8)
        before = self.left.setdefault("networks.digest", digest)
        if not torch.equal(before.cpu(), digest):
            raise CheckpointError(
                "the run was begun with other networks than those that are there now",
                where=files.parts["unet"].parent,
                todo="name the folders of then with --method.weights, or train again with --overwrite",
            )
        log.info("reading the networks")
        return Networks(files, self.device)

    def _load_tuned(self) -> Networks:
        """The networks with what fine-tuning made of them."""
        networks = self._load_networks()
        updates = LowRankUpdates(networks, self.config.lora, self.seed)
        updates.load_weights(
            {k.removeprefix("lora."): v for k, v in self.left.items() if k.startswith("lora.")}
        )
        return networks


def _lasts(name: str) -> bool:
    """Whether part of a run's state is of the Gaussians and colours themselves, not of their optimisers."""
    head, _, rest = name.partition(".")
    return head not in ("adam", "stats") and (head != "colour_correction" or rest == "offsets")
