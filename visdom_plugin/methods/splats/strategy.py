"""The schedule of splats: when Gaussians are cloned, split, pruned and reset, and what that is decided by."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.render import Render
from visdom_plugin.splat.densify import Measured, Proximity, split_children, stray_gaussians, unpooled
from visdom_plugin.splat.model import GaussianSet

log = logging.getLogger(__name__)

FEWEST = 16
"""Of fewer Gaussians none is called stray."""


def every(n: int, first: int, until: int) -> range:
    """Steps `first`, `first + n`, ... before `until`; none where n is 0."""
    return range(first, until, n) if n else range(0)


class LargestGaussian(NamedTuple):
    """How large Gaussians may be."""

    scale: float
    """Of the standard deviations, in extents."""
    radius: float
    """Three standard deviations on screen, as a fraction of the picture's longer side."""
    radius_px: float | None
    """The same in pixels; wins over the fraction."""


class Unpooling(NamedTuple):
    """Where Gaussians are added because they are far apart (FSGS). All lengths are in extents."""

    until: int
    """No step from this one on unpools."""
    distance: float
    """Root mean squared distance to the three nearest neighbours beyond which a Gaussian grows new ones."""
    scale: float
    """Largest standard deviation that it must exceed, too."""
    split_distance: float
    """Such distance beyond which it splits, too, at every densification."""


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
    largest: LargestGaussian | None = None
    """How large one may be that stays then."""
    fewest: int = 0
    """Of so many or fewer, densification removes none but those that it splits."""
    unpooling: Unpooling | None = None
    """Densification by proximity; None for none."""


class Strategy:
    """Adaptive density control of one set of Gaussians (Kerbl et al. 2023, section 5).

    Its state is what it measured of each Gaussian since the last densification (`densify.Measured`). Radii are
    fractions of the picture's longer side, or in pixels where the schedule's is.

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
        self._measured = Measured.nothing(len(splats), splats.device)
        self._removed: Counter[str] = Counter()
        self._most, self._warned = len(splats), False

    def events(self) -> dict[str, list[int]]:
        """What shows in the training curve, and the steps, counted from 1, after which it happens."""
        found = {
            "opacities reset": list(self.schedule.reset_opacity),
            "last Gaussians added": list(self.densify_steps[-1:]),
        }
        return {what: steps for what, steps in found.items() if steps}

    def sh_degree(self, step: int) -> int:
        """Degree of the spherical harmonics in use: training starts at 0."""
        return min(self.splats.config.sh_degree, step // self.splats.config.sh_every)

    def after_backward(self, step: int, render: Render) -> None:
        """The optimiser's step, and all that the schedule asks for then.

        Args:
            render: the training view, after the backward pass.
        """
        self._measure(render)
        self.splats.optimise(step)
        done, schedule = step + 1, self.schedule
        if done in self.densify_steps:
            self._densify(done)
        if done in schedule.remove_strays and len(self.splats) >= FEWEST:
            steps, (first, last) = schedule.remove_strays, schedule.stray_sigmas
            t = (done - steps.start) / max(steps.stop - steps.start, 1)
            strays = stray_gaussians(self.splats.gaussians().means, first + t * (last - first))
            self.remove(strays, "far from their neighbours")
        if done in schedule.reset_opacity:
            self.splats.reset_opacity()
        self._warn_of_loss(done)

    def after_step(self, hooks: Sequence[GaussianHook], step: int) -> None:
        """Removes the Gaussians that hooks mark."""
        for hook in hooks:
            self.remove(hook.after_step(self.splats, step), "outside the hull")

    def remove(self, gone: Tensor | None, why: str) -> None:
        """Removes Gaussians where `gone` (N,) bool is True; all of them, or None, and it removes none."""
        if gone is None or not bool(gone.any()) or bool(gone.all()):
            return
        self._removed[why] += int(gone.sum())
        self.splats.optimiser.keep(~gone)
        self._measured = Measured(*(x[~gone] for x in self._measured))

    def state_dict(self) -> dict[str, Tensor]:
        """The set's parameters and moments, and the measurements, as a flat dict of tensors."""
        return self.splats.state_dict() | {
            "stats.gradient": self._measured.gradient,
            "stats.count": self._measured.seen,
            "stats.radius_px": self._measured.radius,
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        self.splats.load_state_dict(state)
        names = ("gradient", "count", "radius_px")
        self._measured = Measured(*(state[f"stats.{x}"].to(self.splats.device).clone() for x in names))

    def _measure(self, render: Render) -> None:
        info, largest = render.info, self.schedule.largest
        in_pixels = largest is not None and largest.radius_px is not None
        self._measured = self._measured.after(info, 1 if in_pixels else max(info["width"], info["height"]))

    def _densify(self, done: int) -> None:
        """Clones, splits and prunes by what was measured since the last time."""
        splats, c = self.splats, self.splats.config
        p = {name: value.detach() for name, value in splats.optimiser.parameters.items()}
        grow = self._measured.gradient / self._measured.seen.clamp_min(1) >= c.densify_gradient
        if len(splats) >= c.max_gaussians:
            grow = torch.zeros_like(grow)
        largest_scale = p["log_scales"].exp().amax(-1)
        large = largest_scale > c.densify_scale * splats.extent
        clone, split = grow & ~large, grow & large
        unpooling = self.schedule.unpooling if FEWEST <= len(splats) < c.max_gaussians else None
        if unpooling is not None:
            far = Proximity.of(p["means"]).score > unpooling.split_distance * splats.extent
            split = split | (far & (largest_scale > unpooling.scale * splats.extent))
        children = split_children({k: v[split] for k, v in p.items()}, self.split_generator(done))
        splats.optimiser.append({k: torch.cat([v[clone], children[k]]) for k, v in p.items()})
        if unpooling is not None and done < unpooling.until:
            self._unpool(unpooling, split)
        new = len(splats) - len(split)
        shown = splats.gaussians().detach()
        gone = torch.cat([split, split.new_zeros(new)])
        prunes = len(split) > self.schedule.fewest
        if prunes:
            gone = gone | (shown.opacity_logits.sigmoid() < c.prune_opacity)
        start, largest = self.schedule.prune_large_from, self.schedule.largest
        faint = int(gone.sum()) - len(children["means"]) // 2
        if prunes and start is not None and largest is not None and done > start:
            on_screen = torch.cat([self._measured.radius, largest_scale.new_zeros(new)])
            in_space = shown.log_scales.exp().amax(-1)
            gone |= on_screen > (largest.radius if largest.radius_px is None else largest.radius_px)
            gone |= in_space > largest.scale * splats.extent
        if not bool(gone.all()):
            self._removed["fainter than prune_opacity"] += faint
            self._removed["larger than prune_radius or prune_scale"] += (
                int(gone.sum()) - faint - len(children["means"]) // 2
            )
            splats.optimiser.keep(~gone)
        self._measured = Measured.nothing(len(splats), splats.device)

    def _unpool(self, unpooling: Unpooling, split: Tensor) -> None:
        """Adds Gaussians between those that are far apart; the first ones, where `split` is True, are on their way
        out."""
        splats = self.splats
        kept = torch.cat([~split, split.new_ones(len(splats) - len(split))])
        p = {name: value.detach()[kept] for name, value in splats.optimiser.parameters.items()}
        if len(p["means"]) < FEWEST:
            return
        proximity = Proximity.of(p["means"])
        lonely = proximity.score > unpooling.distance * splats.extent
        lonely &= p["log_scales"].exp().amax(-1) > unpooling.scale * splats.extent
        splats.optimiser.append(unpooled(p, proximity, lonely))

    def _warn_of_loss(self, done: int) -> None:
        """Says once when most Gaussians are gone, and why."""
        self._most = max(self._most, len(self.splats))
        if not self._warned and 2 * len(self.splats) < self._most:
            self._warned = True
            why = ", ".join(f"{n} {reason}" for reason, n in self._removed.most_common() if n)
            log.warning(
                "step %d: %d of %d Gaussians are left; removed so far: %s. Fine detail needs more of them: "
                "weaken what removes them, e.g. with --method.prune-radius",
                *(done, len(self.splats), self._most, why),
            )
