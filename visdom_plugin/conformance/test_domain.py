"""What a method does with its hook."""

from __future__ import annotations

import pytest
import torch

from datamodules.manager import DataManager
from visdom_plugin.conformance.bench import carve, mass_outside, scene
from visdom_plugin.conformance.probes import GaussianProbe, SamplerProbe, distance, gradient
from visdom_plugin.conformance.report import require
from visdom_plugin.hooks.protocols import GaussianHook, SamplerHook
from visdom_plugin.training.run import choose_batches

PLACES = {
    "an empty interval at its own near end (hit is False)": ("near", 1e-6),
    "an empty interval at its own far end (hit is False)": ("far", 1e-6),
    "a thousandth of the way, in front of the object": (0.7, 0.05),
    "a thousandth of the way, in the object": (1.0, 0.05),
    "a thousandth of the way, behind the object": (1.3, 0.05),
}
"""Where the probe leaves a ray next to nothing, and how much of the gradient may be left."""


def test_rays_are_sampled_within_their_bounds_only(sampler):
    """Pixels that show no object pull at the field wherever their rays are sampled. When the hook closes the
    bounds, nothing may be left that pulls."""
    probe = SamplerProbe()
    method = sampler.start(hooks=[probe])
    n = sampler.length // 2 + 1
    sampler.run(method, 0, n)
    require(
        probe.calls > 0,
        "no step asks the hook for the rays' bounds",
        SamplerHook,
        "near, far, hit = hook.bound(origins, directions, near, far), for each hook of setup(), in train_step()",
    )
    batch_of = choose_batches(method, DataManager(scene().train, 0))
    # Two batches: what both have in common, such as the decay of parameters, does not come from the rays.
    batches = [batch_of(step)._replace(mask=torch.zeros_like(batch_of(step).mask)) for step in (n, n + 1)]

    def pull() -> float:
        one, other = (gradient(method, batch, n) for batch in batches)
        return distance(one, other)

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


def follow(subject) -> tuple[GaussianProbe, list]:
    """Three steps with the probe in the hook's place; once for each method."""
    if not hasattr(subject, "followed"):
        probe = GaussianProbe(hull_of(subject))
        run = subject.run(subject.start(hooks=[probe]), 0, 3)
        subject.followed = probe, run.losses
    return subject.followed


def hull_of(subject):
    return carve(subject.config.hull)
