"""A method under test: its variants, the scene, and training with everything written down."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin.conformance.report import require
from visdom_plugin.errors import list_some
from visdom_plugin.hull.hull import Hull
from visdom_plugin.registry import Preset, Registry
from visdom_plugin.scene import Scene
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.evaluate import hull_silhouette, render_on_white
from visdom_plugin.training.metrics import outside_hull_mass
from visdom_plugin.training.protocols import Method, StepOutput
from visdom_plugin.training.run import choose_batches, make_hooks
from visdom_plugin.training.runs.saved_hulls import find_hull

CPU = torch.device("cpu")
LENGTH = 60
"""Steps of the two long runs."""

State = dict[str, Tensor]


@cache
def scene() -> Scene:
    """The built-in scene, 50 x 40 pixels, so that no picture is its own transpose."""
    return make_scene(SyntheticConfig(size=(200, 160), downscale=4, test_views=4))


_HULLS: dict[str, Hull | None] = {}


def hull_for(config: Any) -> Hull | None:
    """The hull that a training run hands to a method of this config, found once; None where it asks for none."""
    key = repr(config)
    if key not in _HULLS:
        _HULLS[key] = find_hull(config, scene().train, None)
    return _HULLS[key]


@dataclass
class Run:
    """A method that was trained, and what was seen on the way."""

    method: Method
    states: dict[int, State]
    """Copies of the state after so many steps."""
    losses: list[dict[str, Tensor]]
    """Of each step, detached."""


class Subject:
    """A method and its variants.

    Attributes:
        bare: the variant without a hook, or None where there is none.
        hooked: the variant with the hook, or None.
        main: the one most checks are made with: with the hook where there is one.
    """

    def __init__(self, known: Registry, name: str):
        preset = known.find(name)
        self.name = preset.name
        vd = known.presets.get(f"{preset.name}+vd")
        self.bare: Preset | None = preset
        self.hooked: Preset | None = vd
        if vd is None and getattr(getattr(preset.quick, "vd", None), "enabled", False):
            self.bare, self.hooked = None, preset
        self.main: Preset = self.hooked or preset
        self.hook = self.main.hook
        self.config: Any = self.main.quick

    def start(
        self,
        config: Any = None,
        hooks: Sequence[object] | None = None,
        device: torch.device = CPU,
        luck: int = 0,
    ) -> Method:
        """A method, set up as a training run does it; with other hooks if they are given. `luck` as in `run`."""
        config = self.config if config is None else config
        hull, views = hull_for(config), scene().train
        method = self.main.load()(config)
        hooks = make_hooks(config, hull, views) if hooks is None else hooks
        seed_all(1000 * luck)
        method.setup(views, hooks, hull=hull, device=device, seed=0)
        return method

    def make_hook(self, device: torch.device = CPU) -> object:
        """A new hook, as the variant with the hook gets it."""
        (hook,) = make_hooks(self.config, hull_for(self.config), scene().train)
        return hook

    def run(self, method: Method, first: int, last: int, keep: tuple[int, ...] = (), luck: int = 0) -> Run:
        """Trains from step `first` to before `last`.

        Args:
            keep: numbers of steps after which the state is copied; that at the end always is.
            luck: of the global generators. They start anew before each step, so that a method that draws from
                them fails the one check that is about them, and no other.
        """
        batches = choose_batches(method, DataManager(scene().train, 0))
        states, losses = {}, []
        for step in range(first, last):
            seed_all(1000 * luck + step)
            output = method.train_step(batches(step), step)
            require(
                isinstance(output, StepOutput),
                f"train_step({step}) returned a {type(output).__name__}",
                Method.train_step,
                "return StepOutput({'colour': error.mean()})",
            )
            losses.append({k: v.detach().clone() for k, v in output.losses.items()})
            output.total.backward()
            method.optimise(step, output)
            if step + 1 in keep or step + 1 == last:
                states[step + 1] = copy_state(method)
        return Run(method, states, losses)

    @cached_property
    def length(self) -> int:
        """Steps of the long runs: `LENGTH`, or the whole of a shorter schedule."""
        total = getattr(self.main.load()(self.config), "total_steps", LENGTH)
        return min(LENGTH, total) if isinstance(total, int) and total > 0 else LENGTH

    @property
    def short(self) -> int:
        """Steps of the runs that are compared with the beginning of a long one."""
        return max(1, self.length // 4)

    @property
    def half(self) -> int:
        """Steps of the runs with a probe in the hook's place."""
        return self.length // 2 + 1

    @cached_property
    def trained(self) -> Run:
        """The main variant after `length` steps, its state kept after a quarter, a half and three quarters."""
        n = self.length
        return self.run(self.start(), 0, n, keep=(self.short, n // 2, 3 * n // 4))

    @cached_property
    def trained_bare(self) -> Run:
        """The same for the variant without the hook."""
        assert self.bare is not None, "asked for a method without a bare variant"
        return self.run(self.start(self.bare.quick), 0, self.length, keep=(self.short,))

    def switch_off(self) -> Any:
        """The bare variant's config with the hook's settings, the hook off, and its hull if it has none itself."""
        assert self.bare is not None, "asked for a method without a bare variant"
        bare: Any = self.bare.quick
        vd = self.config
        changes = {"vd": replace(vd.vd, enabled=False)}
        if "hull" in {f.name for f in fields(bare)} and bare.hull is None:
            changes["hull"] = vd.hull
        return replace(bare, **changes)


def copy_state(method: Method) -> State:
    """The state now, apart from what the method goes on to change."""
    return {k: v.detach().clone() for k, v in method.state_dict().items()}


def seed_all(seed: int) -> None:
    """Starts all global generators anew."""
    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)


def global_luck() -> list[object]:
    """The state of all global generators."""
    twister = np.random.get_state(legacy=False)["state"]  # noqa: NPY002
    return [torch.get_rng_state().tolist(), twister["key"].tolist(), twister["pos"], random.getstate()]


def difference(one: State, other: State) -> str:
    """The first tensors that differ in any bit, in words; empty where none does."""
    if one.keys() != other.keys():
        odd = sorted(one.keys() ^ other.keys())
        return f"only one of the two has {list_some(odd, 3)}"
    lines = []
    for name, value in one.items():
        twin = other[name]
        if value.shape != twin.shape:
            lines.append(f"{name}: shape {tuple(value.shape)} and {tuple(twin.shape)}")
        elif not torch.equal(value, twin) and not _same_nan(value, twin):
            lines.append(f"{name}: by {float((value.double() - twin.double()).abs().max()):.3g}")
    return "; ".join(lines[:3])


def _same_nan(value: Tensor, twin: Tensor) -> bool:
    return value.is_floating_point() and torch.equal(value.nan_to_num(), twin.nan_to_num())


def mass_outside(method: Method, hull: Hull) -> float:
    """`outside_hull_mass`, the mean over the test views."""
    cameras = scene().test.cameras
    shares = [
        outside_hull_mass(render_on_white(method, camera, CPU)[1], hull_silhouette(hull, camera))
        for camera in (cameras[i] for i in range(len(cameras)))
    ]
    return sum(shares) / len(shares)
