"""Rays of virtual views in the radiance fields: what they add to a step, and what they do to the field."""

import sys
from dataclasses import replace

import torch

from tests.methods.fields.test_nerf_methods import METHODS, SMALL, start
from tests.methods.short_runs import advance, copy_of, same
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.losses import mask_loss
from visdom_plugin.training.batches import DataManager

from .test_nerf_methods import hull, scene  # noqa: F401  # fixtures


def config_with(method_class, **vd):
    return replace(SMALL[method_class], vd=SamplerConfig(enabled=True, **vd))


@METHODS
def test_the_loss_is_the_cross_entropy_with_nothing(method_class, scene, hull, monkeypatch):  # noqa: F811
    method = start(method_class, scene, hull, config_with(method_class, virtual_views="midpoints"))
    batch = DataManager(scene.train, 0).pixel_batch(0, 64)
    seen = []
    # The method's own, or that of the base which marches.
    modules = [sys.modules[c.__module__] for c in method_class.__mro__ if c.__module__.startswith("visdom")]
    module = next(m for m in modules if hasattr(m, "mask_loss"))
    monkeypatch.setattr(module, "mask_loss", lambda *a, **b: seen.append(a) or mask_loss(*a, **b))
    loss = method.train_step(batch, 0).losses["empty"]
    alpha, mask = seen[-1][:2]
    assert alpha.shape == (16,) and alpha.max() > 0.001 and not mask.any()
    torch.testing.assert_close(loss, 0.1 * -(1 - alpha).log().mean())
    heavier = config_with(method_class, virtual_views="midpoints", virtual_weight=0.5, virtual_rays=1.0)
    method = start(method_class, scene, hull, heavier)
    loss = method.train_step(batch, 0).losses["empty"]
    assert seen[-1][0].shape == (64,)
    torch.testing.assert_close(loss, 0.5 * -(1 - seen[-1][0]).log().mean())


@METHODS
def test_switched_off_a_step_is_as_before_and_on_the_rest_of_it_is(method_class, scene, hull):  # noqa: F811
    off, on = (
        start(method_class, scene, hull, config_with(method_class, virtual_views=v))
        for v in ("none", "between")
    )
    batch = DataManager(scene.train, 0).pixel_batch(0, 64)
    without, with_it = (method.train_step(batch, 0).losses for method in (off, on))
    assert with_it.keys() - without.keys() == {"empty"}
    assert all(torch.equal(without[name], with_it[name]) for name in without)


@METHODS
def test_what_is_opaque_beside_the_hull_fades(method_class, scene, hull):  # noqa: F811
    alone = {"mask_weight": 0.0, "density_bias": 1.0}
    method = start(
        method_class,
        scene,
        hull,
        replace(config_with(method_class, virtual_views="midpoints", virtual_weight=1.0), **alone),
    )
    rays = method.hooks[0].empty_rays(1000, torch.Generator().manual_seed(1))

    def fog():
        bounded = method.bound(rays.origins, rays.directions, [])
        with torch.no_grad():
            draw = torch.Generator().manual_seed(0)
            return float(method.silhouette_of_nothing(bounded, rays.radii, 0, draw))

    before = fog()
    for step in range(25):
        method.empty_losses(128, step)["empty"].backward()
        method.optimiser.step(0.01)
    assert before >= 0.05 and fog() < 0.5 * before


@METHODS
def test_a_resumed_run_draws_what_the_first_would_have(method_class, scene, hull):  # noqa: F811
    config = config_with(method_class, virtual_views="between")
    straight = start(method_class, scene, hull, config)
    advance(straight, scene, range(9))
    saved = copy_of(straight)
    advance(straight, scene, range(9, 14))
    resumed = start(method_class, scene, hull, config)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(9, 14))
    assert same(copy_of(straight), copy_of(resumed))
