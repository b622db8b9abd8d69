"""gsplat (1.4 and 1.5): a companion that stands beside DefaultStrategy or MCMCStrategy in a trainer's loop."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, MutableMapping
from functools import partial
from importlib.metadata import version
from types import ModuleType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import CheckpointError, ConfigError, PluginError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.local_frame import mean_distance, require_near
from visdom_plugin.hooks.protocols import Means
from visdom_plugin.hooks.regularizer import Opacity, VisDomGaussianRegularizer
from visdom_plugin.render import Render
from visdom_plugin.seeding import generator

FADED_OPACITY = 0.004
"""What is left of a faded Gaussian. MCMCStrategy counts what is below its `min_opacity` of 0.005 as dead and moves
it to a living one."""
Params = MutableMapping[str, torch.nn.Parameter]
Optimizers = Mapping[str, torch.optim.Optimizer]
State = dict[str, object]
_CEILING = math.log(FADED_OPACITY / (1 - FADED_OPACITY))


class VisDomStrategy:
    """The visible domain in a gsplat trainer: first points, a loss, and an end for what leaves the hull.

    Has a strategy's methods, takes the other strategy's `state`, and is called after it:

        companion = VisDomStrategy(VisDomGaussianRegularizer(hull, cameras, prune_every=100))
        xyz, rgb = companion.initial_points(20_000)
        ...
        loss = loss + companion.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
        companion.step_post_backward(params, optimizers, state, step, info)

    `params` holds means (N, 3), scales (N, 3) logarithms, quats (N, 4) and opacities (N,) logits, as in gsplat.

    Args:
        hook: weight and schedule of the loss; `prune_every` and `prune_margin_voxels` of what happens outside. Its
            cameras are the trainer's own, in the frame the trainer works in.
        outside: "remove" Gaussians outside the hull with their optimiser and running state; "fade" them, so that
            MCMCStrategy moves them to living ones and their number stays; "keep" them to the loss; "auto" fades
            beside MCMCStrategy and removes beside all others.
        render: draws opacity, `render(params, camera)` -> what `VisDomGaussianRegularizer.loss` takes; the default
            is gsplat's own rasteriser, on CUDA, from a hundredth of the cameras' mean distance on.
        seed: of the loss's views, which depend on nothing else but the step.

    Raises:
        ConfigError: for an unknown `outside`, or a hull too far from the origin for gsplat, which is in float32.
    """

    def __init__(
        self,
        hook: VisDomGaussianRegularizer,
        *,
        outside: Literal["auto", "remove", "fade", "keep"] = "auto",
        render: Callable[[Params, Cameras], Opacity | Tensor] | None = None,
        seed: int = 0,
    ):
        if outside not in ("auto", "remove", "fade", "keep"):
            raise ConfigError(f"outside is {outside!r}", todo='use "auto", "remove", "fade" or "keep"')
        extent = hook.hull.extent
        require_near(extent, float(np.ptp(extent, axis=0).max()), "VisDomStrategy")
        self.hook, self.outside, self.seed = hook, outside, seed
        self.render = render or partial(draw_opacity, near=0.01 * float(mean_distance(hook.cameras)))
        self.ended = 0
        """Gaussians removed or faded so far; one that MCMCStrategy revives outside counts again."""

    def initialize_state(self, state: State | None = None) -> State:
        """Starts counting anew. Returns the other strategy's running state, which both share."""
        self.ended = 0
        return {} if state is None else state

    def initial_points(self, n: int) -> tuple[Tensor, Tensor]:
        """Where Gaussians start: xyz (n, 3) and rgb (n, 3) in [0, 1]."""
        return self.hook.initial_points(n, generator(self.seed, "initial_points"))

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: State | None = None
    ) -> Tensor:
        """The loss to add, a scalar; zero on steps without it."""
        draw = generator(self.seed, "gsplat", step)
        losses = self.hook.loss(lambda camera: self.render(params, camera), step, draw)
        return sum(losses.values(), params["means"].new_zeros(()))

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: State | None = None,
        **_: object,
    ) -> int:
        """Ends Gaussians outside the hull, `params`, `optimizers` and `state` alike; returns how many."""
        gone = self.hook.after_step(Means(params["means"]), step)
        policy = ("fade" if "binoms" in state else "remove") if self.outside == "auto" else self.outside
        if gone is None or policy == "keep" or not bool(gone.any()) or bool(gone.all()):
            return 0
        if policy == "fade":
            gone &= params["opacities"].flatten() > _CEILING
            _fade(params["opacities"], optimizers["opacities"], gone)
        else:
            _remove(params, optimizers, state, gone)
        self.ended += int(gone.sum())
        return int(gone.sum())

    def state_dict(self) -> dict[str, int]:
        """What a resumed run needs: plain numbers. The trainer keeps `state` itself."""
        hull = self.hook.hull
        check = zlib.crc32(np.packbits(hull.occupancy).tobytes() + hull.bounds.tobytes())
        return {"seed": self.seed, "ended": self.ended, "hull": check}

    def load_state_dict(self, saved: Mapping[str, int]) -> None:
        """Takes over what `state_dict` gave.

        Raises:
            CheckpointError: when it was another seed or another hull.
        """
        own = self.state_dict()
        if {**saved, "ended": 0} != {**own, "ended": 0}:
            raise CheckpointError(
                f"the checkpoint's companion was {saved}, this one is {own}",
                cause="another hull, or another seed",
                todo="resume with the hull (Hull.save, Hull.load) and the seed of the first run",
            )
        self.ended = saved["ended"]


def draw_opacity(params: Params, camera: Cameras, near: float = 0.01) -> Tensor:
    """(H, W) opacity of gsplat's parameters by gsplat's own rasteriser, which needs CUDA.

    Args:
        near: Gaussians nearer than this are not drawn, scene units.
    """
    rasterization = _gsplat().rasterization
    means = params["means"]
    _, alphas, _ = rasterization(
        means,
        params["quats"],
        params["scales"].exp(),
        params["opacities"].flatten().sigmoid(),
        torch.zeros_like(means),
        camera.camera_from_world.to(means)[None],
        camera.intrinsics.to(means)[None],
        *camera.size,
        near_plane=near,
        packed=False,
    )
    return alphas[0, ..., 0]


def info_of(render: Render) -> State:
    """What gsplat's strategies want as `info`, of a view that `visdom_plugin.splat.rasterise` drew.

    Radii are (1, N, 2) from gsplat 1.5 on, (1, N) before.
    """
    own = render.info
    radii = own["radii"]
    if radii.ndim == 2 and version("gsplat").startswith("1.4."):
        radii = radii.amax(-1)
    return {
        "means2d": _Means2d(own["means2d"]),
        "radii": radii[None],
        "width": own["width"],
        "height": own["height"],
        "n_cameras": 1,
        "gaussian_ids": None,
    }


class _Means2d:
    """Means (N, 2) in the shape of a batch of one camera; only their gradient is asked for."""

    def __init__(self, means2d: Tensor):
        self._means2d = means2d

    def retain_grad(self) -> None:
        """The rasteriser has seen to it."""

    @property
    def grad(self) -> Tensor | None:
        grad = self._means2d.grad
        return None if grad is None else grad[None]


def _fade(opacities: Tensor, optimizer: torch.optim.Optimizer, gone: Tensor) -> None:
    """Lowers opacities in place and forgets their moments, which would carry them up again."""
    opacities[gone] = opacities[gone].clamp(max=_CEILING)
    for value in optimizer.state[opacities].values():
        if isinstance(value, Tensor) and value.shape == opacities.shape:
            value[gone] = 0


def _remove(params: Params, optimizers: Optimizers, state: State, gone: Tensor) -> None:
    # Of the running state only what has one row per Gaussian; gsplat's `remove` would cut everything.
    rows = {
        key: value
        for key, value in state.items()
        if isinstance(value, Tensor) and value.shape[:1] == gone.shape and key != "binoms"
    }
    _gsplat().strategy.ops.remove(params=params, optimizers=optimizers, state=rows, mask=gone)
    state.update(rows)


def _gsplat() -> ModuleType:
    try:
        import gsplat
        import gsplat.strategy.ops
    except ImportError as error:
        raise PluginError(
            "this needs gsplat, which cannot be imported",
            cause=str(error),
            todo="pip install gsplat",
            topic="not-installed",
        ) from error
    return gsplat
