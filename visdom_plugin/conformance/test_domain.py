"""Tests of what a method does with its hook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from visdom_plugin.conformance.probes import GaussianProbe, SamplerProbe, distance, gradient
from visdom_plugin.conformance.report import require
from visdom_plugin.conformance.subject import hull_for, mass_outside, scene
from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import GaussianHook, SamplerHook
from visdom_plugin.hooks.sampler import VisDomSampler
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.protocols import Method
from visdom_plugin.training.run import choose_batches

PLACES = {
    "an empty interval at its own near end (hit is False)": ("near", 1e-6),
    "an empty interval at its own far end (hit is False)": ("far", 1e-6),
    "a thousandth of the way, in front of the object": (0.7, 0.05),
    "a thousandth of the way, in the object": (1.0, 0.05),
    "a thousandth of the way, behind the object": (1.3, 0.05),
}
"""Where the probe leaves a ray next to nothing, and how much of the gradient may be left."""
MISSES = {
    "leaves rays an empty interval (hit is False)": "near",
    "says that rays miss the hull (hit is False), and leaves their bounds as they are": "missed",
}
"""What the probe does, and its `place`."""


def test_rays_are_sampled_within_their_bounds_only(sampler):
    """Pixels that show no object pull at the field wherever their rays are sampled. When the hook closes the
    bounds, nothing may be left that pulls."""
    probe = SamplerProbe()
    pull = pull_of(train_with(sampler, probe), sampler.half)
    require(
        probe.calls > 0,
        "no step asks the hook for the rays' bounds",
        SamplerHook,
        "near, far, hit = hook.bound(origins, directions, near, far), for each hook of setup(), in train_step()",
    )
    free = pull()
    require(
        free > 0,
        "no gradient of train_step's losses reaches a parameter, with the method's own bounds",
        SamplerHook,
        "see that the losses depend on parameters where the hook leaves the bounds as they are",
    )
    for words, (place, most) in PLACES.items():
        probe.place = place
        left = pull() / free
        require(
            left <= most,
            f"the hook leaves rays {words}, and {left:.2g} of their gradient is still there: they are sampled "
            "outside their bounds",
            SamplerHook,
            "take samples from the hook's near to its far at all levels, and give the last one no length beyond",
        )


def test_samples_outside_the_hull_are_dropped_where_the_setting_is_taken(sampler):
    config = with_settings(sampler, drop_outside=True)
    if config is None:
        pytest.skip(f"{sampler.name} has no setting vd.drop_outside, or refuses it")
    probe = SamplerProbe(drop_outside=True)
    pull = pull_of(train_with(sampler, probe, config), sampler.half)
    free = pull()
    probe.place = "nowhere"
    left = pull()
    require(
        left <= 1e-6 * free,
        f"with vd.drop_outside the hook's keep() keeps no sample, and {left:.2g} of a gradient of {free:.2g} is "
        "still there",
        VisDomSampler.keep,
        "ask keep() of each hook about each sample's point; or refuse vd.drop_outside with a ConfigError in the "
        "config's __post_init__, as is done for configs without a field vd of their own",
    )


def test_the_hull_has_no_part_in_novel_views_unless_asked_for(sampler):
    config = with_settings(sampler, hull_at_inference=False) or sampler.config
    probe = SamplerProbe()
    method = train_with(sampler, probe, config)
    before = probe.calls
    method.render(scene().test.cameras[0], torch.ones(3))
    require(
        probe.calls == before,
        f"config.vd.hull_at_inference is off, and render() asks the hook for bounds {probe.calls - before} times",
        Method.render,
        "hooks = self.hooks if self.config.vd.hull_at_inference else []",
    )


def test_the_hull_at_inference_bounds_novel_views(sampler):
    config = with_settings(sampler, hull_at_inference=True)
    if config is None:
        pytest.skip(f"{sampler.name} has no setting vd.hull_at_inference, or refuses it")
    probe = SamplerProbe()
    method = train_with(sampler, probe, config)
    before = probe.calls
    for words, place in MISSES.items():
        probe.place = place
        alpha = method.render(scene().test.cameras[0], torch.ones(3)).alpha
        require(
            probe.calls > before and float(alpha.max()) <= 1e-6,
            f"config.vd.hull_at_inference is on, the hook {words}, and render() asks it {probe.calls - before} "
            f"times and shows an opacity of up to {float(alpha.max()):.2g}",
            SamplerConfig,
            "bound the rays of render() by the hooks, too, and show the background where hit is False; or refuse "
            "the setting with a ConfigError in the config's __post_init__",
        )


def test_gaussians_begin_at_the_hooks_points(gaussian):
    probe, _ = follow(gaussian)
    first = probe.seen.get(0, [])
    require(
        bool(probe.points), "setup() never asks initial_points()", GaussianHook.initial_points, "ask hooks[0]"
    )
    start = torch.cat(probe.points)
    require(
        bool(first) and all(len(means) for means in first),
        "optimise(0) never calls after_step(gaussians, step), with gaussians.means",
        GaussianHook.after_step,
        "call it for each hook after the optimiser's step",
    )
    away = max(float(torch.cdist(means, start.to(means)).amin(1).median()) for means in first)
    radius = float(hull_of(gaussian).radius)
    require(
        away < 0.05 * radius,
        f"after one step, half of the Gaussians are {away / radius:.2g} hull radii or more from all of the hook's "
        "points",
        GaussianHook.initial_points,
        "start with one Gaussian at each of them",
    )


def test_the_hooks_losses_take_part(gaussian):
    probe, losses = follow(gaussian)
    require(
        bool(probe.renders) and probe.renders[0].alpha.requires_grad,
        "the hook's loss is never asked for, or its render callable gives alpha without gradient",
        GaussianHook.loss,
        "losses |= hook.loss(render, step, generator), where render(camera) draws the current Gaussians",
    )
    missing = [step for step, found in enumerate(losses) if not any(probe.LOSS in name for name in found)]
    require(
        not missing,
        f"what the hook's loss() returned is not among the losses of steps {missing}",
        GaussianHook.loss,
        "return the hook's losses from train_step with the method's own",
    )


def test_gaussians_marked_by_the_hook_are_removed(gaussian):
    probe, _ = follow(gaussian)
    before, gone, after = probe.seen.get(0, []), probe.marked.get(0, []), probe.seen.get(1, [])
    counts = [(len(b), int(g.sum()), len(a)) for b, g, a in zip(before, gone, after, strict=False)]
    kept = [n - marked == left for n, marked, left in counts]
    require(
        bool(kept) and all(kept),
        "of (there, marked, there a step later) Gaussians: " + ", ".join(map(str, counts)),
        GaussianHook.after_step,
        "remove the Gaussians that it returns True for, with their optimiser's state",
    )


def test_opacity_outside_the_hull_falls(hooked):
    """Measured on unseen views, against the bare method after the same few steps."""
    if hooked.bare is None:
        pytest.skip(f"{hooked.name} has no variant without a hook")
    hull = hull_of(hooked)
    bare, vd = (mass_outside(run.method, hull) for run in (hooked.trained_bare, hooked.trained))
    require(
        vd < bare or vd == 0,
        f"after {hooked.length} steps, {vd:.4f} of the opacity lies outside the hull with the hook, {bare:.4f} "
        "without",
        SamplerHook if hooked.hook == "sampler" else GaussianHook,
        "pass hooks on to where rays or Gaussians are, and let the silhouette loss have config.mask_weight",
    )


def with_settings(subject, **settings: bool) -> Any:
    """The config with other settings of the hook; None where it has no such setting, or refuses it."""
    vd = subject.config.vd
    if not all(hasattr(vd, name) for name in settings):
        return None
    try:
        return replace(subject.config, vd=replace(vd, **settings))
    except ConfigError:
        return None


def train_with(subject, probe: SamplerProbe, config: Any = None) -> Method:
    """The method, half trained with a probe in the hook's place."""
    method = subject.start(config, hooks=[probe])
    subject.run(method, 0, subject.half)
    return method


def pull_of(method: Method, step: int) -> Callable[[], float]:
    """How much pixels that show no object pull at the field, whenever it is asked: always the same pixels."""
    batch_of = choose_batches(method, DataManager(scene().train, 0))
    # Two batches: what both have in common, such as the decay of parameters, does not come from the rays.
    batches = [replace(batch, mask=torch.zeros_like(batch.mask)) for batch in map(batch_of, (step, step + 1))]

    def pull() -> float:
        one, other = (gradient(method, batch, step) for batch in batches)
        return distance(one, other)

    return pull


def follow(subject) -> tuple[GaussianProbe, list]:
    """Three steps with the probe in the hook's place; once for each method."""
    if not hasattr(subject, "followed"):
        probe = GaussianProbe(hull_of(subject))
        run = subject.run(subject.start(hooks=[probe]), 0, 3)
        subject.followed = probe, run.losses
    return subject.followed


def hull_of(subject):
    return hull_for(subject.config)
