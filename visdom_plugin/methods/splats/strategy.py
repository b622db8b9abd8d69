"""The schedule of splats: when Gaussians are cloned, split, pruned and reset, and what that is decided by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.render import Render
from visdom_plugin.splat.densify import split_children, stray_gaussians
from visdom_plugin.splat.model import GaussianSet

FEWEST = 16
"""Of fewer Gaussians none is called stray."""


def every(n: int, first: int, until: int) -> range:
    """Steps `first`, `first + n`, ... before `until`; none where n is 0."""
    return range(first, until, n) if n else range(0)


@dataclass(frozen=True)
class Schedule:
    """The steps, counted from 1, after which a set changes besides being densified as its config says."""

    reset_opacity: range
    """Opacities fall to 0.01."""
    remove_strays: range = range(0)
    """Statistical removal of stray Gaussians (GaussianObject)."""
    stray_sigmas: tuple[float, float] = (1.0, 1.0)
    """Its threshold in standard deviations, from the first of these steps to the last."""
    prune_large_from: int | None = None
    """After this step densification removes large Gaussians, too; None for never."""
    largest: tuple[float, float] = (float("inf"), float("inf"))
    """Largest radius in pixels and largest scale in extents that may stay then."""


class Strategy:
    """Adaptive density control of one set of Gaussians (Kerbl et al. 2023, section 5).

    Its state is what it measured of each Gaussian since the last densification: the sum of the norms of the loss's
    gradient by the projected mean, in how many steps the Gaussian was seen, and its largest radius in pixels.

    Args:
        splats: the set; from here on Gaussians are removed through the strategy alone.
        schedule: when the set changes.
        split_generator: of a step, counted from 1, where the halves of split Gaussians go.
    """

    def __init__(self, splats: GaussianSet, schedule: Schedule, split_generator: Callable[[int], Generator]):
        self.splats, self.schedule, self.split_generator = splats, schedule, split_generator
        c = splats.config
        first = c.densify_every * (c.densify_from // c.densify_every + 1)
        self.densify_steps = every(c.densify_every, first, c.densify_until)
        self._gradient = self._count = self._radius_px = torch.zeros(len(splats), device=splats.device)

    def sh_degree(self, step: int) -> int:
        """Degree of the spherical harmonics in use: training starts at 0."""
        return min(self.splats.config.sh_degree, step // self.splats.config.sh_every)

    def after_backward(self, step: int, render: Render) -> None:
        """The optimiser's step, and all that the schedule asks for then.

        Args:
            render: the training view, after the backward pass.
        """
        self._measure(render.info)
        self.splats.optimise(step)
        done, schedule = step + 1, self.schedule
        if done in self.densify_steps:
            self._densify(done)
        if done in schedule.remove_strays and len(self.splats) >= FEWEST:
            steps, (first, last) = schedule.remove_strays, schedule.stray_sigmas
            t = (done - steps.start) / max(steps.stop - steps.start, 1)
            self.remove(stray_gaussians(self.splats.means, first + t * (last - first)))
        if done in schedule.reset_opacity:
            self.splats.reset_opacity()

    def after_step(self, hooks: Sequence[GaussianHook], step: int) -> None:
        """Removes the Gaussians that hooks mark."""
        for hook in hooks:
            self.remove(hook.after_step(self.splats.gaussians(), step))

    def remove(self, gone: Tensor | None) -> None:
        """Removes Gaussians where `gone` (N,) bool is True; all of them, or None, and it removes none."""
        if gone is None or not bool(gone.any()) or bool(gone.all()):
            return
        self.splats.optimiser.keep(~gone)
        self._gradient, self._count, self._radius_px = (
            x[~gone] for x in (self._gradient, self._count, self._radius_px)
        )

    def state_dict(self) -> dict[str, Tensor]:
        """The set's parameters and moments, and the measurements, as a flat dict of tensors."""
        return self.splats.optimiser.state_dict() | {
            "stats.gradient": self._gradient,
            "stats.count": self._count,
            "stats.radius_px": self._radius_px,
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        self.splats.optimiser.load_state_dict(state)
        self._gradient, self._count, self._radius_px = (
            state[f"stats.{name}"].to(self.splats.device).clone()
            for name in ("gradient", "count", "radius_px")
        )

    def _measure(self, info: dict[str, Any]) -> None:
        # In normalised device units. Numbers, not a tensor: a copy to the GPU would wait for it.
        u, v = info["means2d"].grad.unbind(-1)
        norm = torch.stack([u * (info["width"] / 2), v * (info["height"] / 2)], -1).norm(dim=-1)
        visible = info["visible"]
        self._gradient = self._gradient + torch.where(visible, norm, 0)
        self._count = self._count + visible
        radii = info["radii"] if info["radii"].ndim == 1 else info["radii"].amax(-1)
        self._radius_px = torch.maximum(self._radius_px, torch.where(visible, radii, 0).float())

    def _densify(self, done: int) -> None:
        """Clones, splits and prunes by what was measured since the last time."""
        splats, c = self.splats, self.splats.config
        p = {name: value.detach() for name, value in splats.optimiser.parameters.items()}
        grow = self._gradient / self._count.clamp_min(1) >= c.densify_gradient
        if len(splats) >= c.max_gaussians:
            grow = torch.zeros_like(grow)
        large = p["log_scales"].exp().amax(-1) > c.densify_scale * splats.extent
        clone, split = grow & ~large, grow & large
        children = split_children({k: v[split] for k, v in p.items()}, self.split_generator(done))
        splats.optimiser.append({k: torch.cat([v[clone], children[k]]) for k, v in p.items()})
        new = len(splats) - len(split)
        p = {name: value.detach() for name, value in splats.optimiser.parameters.items()}
        gone = torch.cat([split, split.new_zeros(new)]) | (p["opacity_logits"].sigmoid() < c.prune_opacity)
        start = self.schedule.prune_large_from
        if start is not None and done > start:
            radius, scale = self.schedule.largest
            on_screen = torch.cat([self._radius_px, self._radius_px.new_zeros(new)])
            in_space = p["log_scales"].exp().amax(-1)
            gone |= (on_screen > radius) | (in_space > scale * splats.extent)
        if not bool(gone.all()):
            splats.optimiser.keep(~gone)
        self._gradient = self._count = self._radius_px = torch.zeros(len(splats), device=splats.device)
