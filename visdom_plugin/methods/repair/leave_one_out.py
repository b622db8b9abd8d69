"""Leave-one-out runs: how the coarse stage draws a view that it lacks, and how its Gaussians differ then."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Generator, Tensor

from visdom_plugin import seeding
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hooks.protocols import GaussianHook, Placed
from visdom_plugin.methods.repair.configs import GaussianObjectConfig
from visdom_plugin.methods.repair.pictures import as_bytes, centre_square
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.training.protocols import StepOutput, ViewBatch

State = dict[str, Tensor]
MakeRun = Callable[[GaussianObjectConfig, Sequence[GaussianHook], int], GsGo]
"""A coarse run set up on all training views, by its settings, hooks and seed."""
NOISED = ("means", "log_scales", "quaternions", "opacity_logits")
"""Attributes that get noise; colours keep theirs (the authors' code)."""

log = logging.getLogger(__name__)


class RemovesUntil:
    """A hook that removes no Gaussian from a step on; else the one it wraps."""

    def __init__(self, hook: GaussianHook, until: int):
        self.hook, self.until = hook, until

    def initial_points(self, n: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        return self.hook.initial_points(n, generator)

    def loss(self, render: Callable[[Cameras], Render], step: int, generator: Generator) -> State:
        return self.hook.loss(render, step, generator)

    def after_step(self, gaussians: Placed, step: int) -> Tensor | None:
        return self.hook.after_step(gaussians, step) if step < self.until else None


class LeaveOneOut:
    """One run for each view, one after the other, each with a twin.

    A run lacks its view until the step of its return; then it goes on with all views, and after that the
    twin, from the same state, without the view. What is kept are renders of the view from just after its
    return, and mean and deviation over the Gaussians of run minus twin.

    Args:
        cameras: (N,) training cameras.
        make_run: sets up the run of a view.
    """

    def __init__(
        self,
        config: GaussianObjectConfig,
        cameras: Cameras,
        hooks: Sequence[GaussianHook],
        make_run: MakeRun,
        seed: int,
    ):
        self.config, self.cameras, self.make_run, self.seed = config, cameras, make_run, seed
        c = config.loo
        self.per_view = 2 * c.steps - c.view_returns
        self.steps = len(cameras) * self.per_view
        self.hooks = [RemovesUntil(hook, c.view_returns) for hook in hooks]
        self.kept: State = {}
        """Renders by view and number, and the noise of each view."""
        self.held: State = {}
        """The run's state just before the view returned."""
        self.first: State = {}
        """The run's attributes at its end."""
        self._begin(0)

    def view_at(self, step: int) -> int:
        """The training view of a step."""
        view, local = divmod(step, self.per_view)
        c, count = self.config.loo, len(self.cameras)
        all_views = c.view_returns <= local < c.steps
        part = "with" if all_views else "twin" if local >= c.steps else "without"
        among = [i for i in range(count) if all_views or i != view]
        start = 0 if part == "without" else c.view_returns if part == "with" else c.steps
        epoch, position = divmod(local - start, len(among))
        order = torch.randperm(len(among), generator=seeding.generator(self.seed, "loo", part, view, epoch))
        return among[int(order[position])]

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        return self.run.train_step(batch, self._inner(step))

    def optimise(self, step: int, output: StepOutput) -> None:
        view, local = divmod(step, self.per_view)
        self.run.optimise(self._inner(step), output)
        c, done = self.config.loo, local + 1
        if done == c.view_returns:
            self.held = _copy(self.run.state_dict())
        since = done - c.view_returns
        if 0 < since <= c.kept_steps and done <= c.steps and since % len(self.cameras) == 0:
            number = since // len(self.cameras)
            self.kept[f"renders.{view}.{number:04d}"] = self._draw(view)
        if done == c.steps:
            if f"renders.{view}.0001" not in self.kept:
                self.kept[f"renders.{view}.0001"] = self._draw(view)
            self.first = _attributes(self.run)
            self.run.load_state_dict(self.held)
        if done == self.per_view:
            for name, twin in _attributes(self.run).items():
                difference = self.first[name] - twin
                self.kept[f"noise.{view}.{name}.mean"] = difference.mean(0)
                self.kept[f"noise.{view}.{name}.std"] = difference.std(0)
            if view + 1 < len(self.cameras):
                self._begin(view + 1)

    def result(self) -> State:
        """What later stages need."""
        return dict(self.kept)

    def state_dict(self) -> State:
        parts = {"run": self.run.state_dict(), "held": self.held, "first": self.first, "kept": self.kept}
        return {f"{part}.{k}": v for part, state in parts.items() for k, v in state.items()}

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        self._begin(min(step // self.per_view, len(self.cameras) - 1))
        parts: dict[str, State] = {"run": {}, "held": {}, "first": {}, "kept": {}}
        for name, value in state.items():
            part, _, rest = name.partition(".")
            parts[part][rest] = value
        self.run.load_state_dict(parts["run"])
        self.held, self.first, self.kept = (
            {k: v.to(self.run.device) for k, v in parts[part].items()} for part in ("held", "first", "kept")
        )

    def _begin(self, view: int) -> None:
        c = self.config.loo
        config = replace(
            self.config,
            steps=c.steps,
            densify_until=min(self.config.densify_until, c.view_returns),
            # Of degree 0 to the end.
            sh_every=c.steps,
        )
        seed = int(torch.randint(1 << 31, (), generator=seeding.generator(self.seed, "loo", view)))
        self.run = self.make_run(config, self.hooks, seed)
        self.held, self.first = {}, {}
        log.info("leave-one-out: view %d of %d is left out", view + 1, len(self.cameras))

    def _inner(self, step: int) -> int:
        """The step of the run, or of its twin, that a step of the stage is."""
        c, local = self.config.loo, step % self.per_view
        return local if local < c.steps else local - c.steps + c.view_returns

    def _draw(self, view: int) -> Tensor:
        white = torch.ones(3, device=self.run.device)
        camera = self.cameras[view].to(self.run.device)
        return as_bytes(centre_square(self.run.render(camera, white).rgb, self.config.image_size))


def add_noise(
    gaussians: Gaussians, kept: Mapping[str, Tensor], config: GaussianObjectConfig, draw: Generator
) -> Gaussians:
    """The Gaussians with noise like that of Gaussians that lack a view.

    Args:
        kept: what `LeaveOneOut.result` gave, the mean of whose views is the noise.
        draw: CPU generator.
    """
    c, changed = config.lora, {}
    dropout, scale = (_between(limits, draw) for limits in (c.noise_dropout, c.noise_scale))
    for name in NOISED:
        value = getattr(gaussians, name)
        mean, deviation = (_mean_noise(kept, f".{name}.{what}").to(value) for what in ("mean", "std"))
        noise = mean + deviation * torch.randn(value.shape, generator=draw).to(value)
        if name != "means":
            noise = noise.clamp(mean - scale * deviation, mean + scale * deviation)
        dropped = torch.rand(value.shape, generator=draw).to(value) < dropout
        changed[name] = value + noise.masked_fill(dropped, 0)
    return replace(gaussians, **changed)


def _mean_noise(kept: Mapping[str, Tensor], end: str) -> Tensor:
    """The mean over the views of one of their numbers."""
    return torch.stack([v for k, v in kept.items() if k.startswith("noise.") and k.endswith(end)]).mean(0)


def _between(limits: tuple[float, float], draw: Generator) -> float:
    """A number drawn evenly from low to high."""
    low, high = limits
    return low + (high - low) * float(torch.rand((), generator=draw))


def _attributes(run: GsGo) -> State:
    return {k: v.clone() for k, v in run.splats.gaussians().detach().tensors().items() if k in NOISED}


def _copy(state: Mapping[str, Tensor]) -> State:
    return {k: v.detach().clone() for k, v in state.items()}
