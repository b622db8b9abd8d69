"""Switches for few views: dropout and virtual views, in every method of Gaussians."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.scene import SyntheticConfig, make_scene
from method_configs import corgs_lite, fsgs_lite, gs_go
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.inside.shape import shape_inside
from visdom_plugin.methods.splats import virtual_views
from visdom_plugin.methods.splats.common import drop_some
from visdom_plugin.methods.splats.virtual_views import VirtualViews
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians

METHODS = {
    spec.name: spec.presets()[f"{spec.name}+vd"] for spec in (gs_go.SPEC, corgs_lite.SPEC, fsgs_lite.SPEC)
}


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=40))


@pytest.fixture(scope="module")
def hull(scene):
    hull = VisibleDomain(resolution=40).carve(*scene.train.silhouettes())
    return replace(hull, inner=shape_inside(hull, *scene.train.silhouettes()))


def begin(name, scene, hull, **changes):
    config = replace(
        METHODS[name].quick, steps=12, initial_points=300, densify_from=4, densify_every=4, **changes
    )
    return set_up(METHODS[name].load(), config, scene, hull)


def some(n=1000):
    ones = torch.ones(n, 3)
    logits = torch.linspace(-3, 3, n).requires_grad_()
    return Gaussians(ones, ones, torch.ones(n, 4), logits, torch.ones(n, 1, 3))


def test_dropped_gaussians_are_gone_and_the_others_make_up_for_them():
    before = some()
    after = drop_some(before, 0.25, torch.Generator().manual_seed(0))
    opacity, was = after.opacity_logits.sigmoid(), before.opacity_logits.sigmoid()
    gone = opacity < 1e-6
    assert 0.2 < gone.float().mean() < 0.3
    torch.testing.assert_close(opacity[~gone], (was[~gone] / 0.75).clamp_max(0.995))
    opacity.sum().backward()
    gradient = before.opacity_logits.grad
    assert not gradient[gone].any() and (gradient[~gone & (was < 0.7)] > 0).all()
    assert drop_some(before, 0.0, torch.Generator()) is before


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("switch", [{"dropout": 0.3}, {"virtual_weight": 0.2}])
def test_a_switch_changes_training_and_a_resumed_run_does_not_notice(name, switch, scene, hull):
    plain, straight, resumed = (begin(name, scene, hull, **s) for s in ({}, switch, switch))
    advance(plain, scene, range(12))
    advance(straight, scene, range(7))
    resumed.load_state_dict(copy_of(straight))
    advance(straight, scene, range(7, 12))
    advance(resumed, scene, range(7, 12))
    assert same(copy_of(straight), copy_of(resumed))
    assert not same(copy_of(straight), copy_of(plain))


def test_a_virtual_view_pulls_towards_the_warped_photographs_on_any_background(scene, hull, monkeypatch):
    virtual = VirtualViews(hull.inner, scene.train)
    _, rgb, trust, silhouette = virtual._view(5)
    assert silhouette.any() and trust[silhouette].float().mean() > 100
    monkeypatch.setattr(virtual_views, "BANK", 1)
    virtual._bank[0] = virtual._bank[5]
    for background in (torch.zeros(3), torch.tensor([0.2, 0.9, 0.4])):

        def loss(picture, background=background):
            alpha = torch.ones(picture.shape[:2])
            return float(virtual.loss(lambda _: Render(picture, alpha, alpha), background, torch.Generator()))

        target = torch.where(silhouette[..., None], rgb / 255, background)
        unknown = (trust == 0) & silhouette
        assert loss(target) == 0 and loss(target + 0.1 * unknown[..., None]) == 0
        beside = loss(target + 0.1 * ~silhouette[..., None])
        assert beside == pytest.approx(0.1 * float((~silhouette).float().mean()), abs=1e-6)


def test_only_given_masks_and_pixels_that_are_not_ignored_are_warped(scene, hull):
    ignore = [torch.ones(40, 40, dtype=torch.bool), None, None, None]
    views = replace(scene.train, mask_origins=["given", "missing", "given", "given"], ignore=ignore)
    virtual = VirtualViews(hull, views)
    assert len(virtual.cameras) == 3
    assert not virtual.warp.masks[0].any() and virtual.warp.masks[1].any()


@pytest.mark.parametrize(
    "settings", [{"dropout": 1.0}, {"virtual_weight": -1.0}, {"virtual_weight": 1.0, "hull": None}]
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        replace(gs_go.SPEC.quick, **settings)
