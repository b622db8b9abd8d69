"""3DGS-GO: what it learns, and that its state is all there is."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.gs_go import SPEC
from tests.methods.short_runs import advance, set_up
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.common import scene_extent
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.methods.splats.initial_points import mean_masked_colour

SMALL = replace(
    SPEC.quick,
    steps=60,
    initial_points=600,
    densify_from=10,
    densify_until=50,
    densify_every=10,
    floater_every=20,
    opacity_reset_every=40,
    prune_large_from=20,
    sh_every=15,
    hull=VisibleDomain(resolution=48),
    vd=RegularizerConfig(enabled=True),
)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=64))


@pytest.fixture(scope="module")
def hull(scene):
    return SMALL.hull.carve(scene.train.cameras, scene.train.masks)


def start(scene, hull, config=SMALL, hooks=None, seed=0):
    return set_up(GsGo, config, scene, hull, hooks, seed)


def test_it_learns(scene, hull):
    # Without the opacity reset, whose dip sixty steps do not make up for.
    method = start(scene, hull, replace(SMALL, opacity_reset_every=0))
    before = method.render(scene.train.cameras[0], torch.ones(3)).rgb
    history = advance(method, scene, range(60))
    after = method.render(scene.train.cameras[0], torch.ones(3)).rgb
    mask = scene.train.masks[0][..., None]
    truth = torch.where(mask, scene.train.images[0].float() / 255, 1.0)
    assert sum(history[-8:]) < 0.8 * sum(history[:8])
    assert (after - truth).square().mean() < 0.7 * (before - truth).square().mean()


def test_events_are_the_steps_at_which_the_set_changes(scene, hull):
    method = start(scene, hull)
    assert method.events() == {"opacities reset": [40], "last Gaussians added": [40]}
    advance(method, scene, range(39))
    assert method.splats.gaussians().opacity_logits.sigmoid().max() > 0.1
    advance(method, scene, range(39, 40))
    assert method.splats.gaussians().opacity_logits.sigmoid().max() < 0.02
    late = replace(SMALL, densify_until=55)
    assert start(scene, hull, late).events()["last Gaussians added"] == [50]
    assert "opacities reset" not in start(scene, hull, replace(SMALL, opacity_reset_every=0)).events()


def test_a_resumed_run_equals_the_uninterrupted_one(scene, hull):
    straight = start(scene, hull)
    advance(straight, scene, range(33))
    saved = {k: v.clone() for k, v in straight.state_dict().items()}
    advance(straight, scene, range(33, 60))
    resumed = start(scene, hull)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(33, 60))
    assert straight.state_dict().keys() == resumed.state_dict().keys()
    for name, value in straight.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


class Bystander:
    """A hook that does nothing but draw numbers."""

    def __init__(self, points):
        self.points = points

    def initial_points(self, n, generator):
        return self.points

    def loss(self, render, step, generator):
        torch.rand(7, generator=generator)
        return {}

    def after_step(self, gaussians, step):
        return None


def test_a_hook_that_adds_nothing_changes_nothing(scene, hull):
    config = replace(SMALL, vd=RegularizerConfig())
    plain = start(scene, hull, config, hooks=[])
    p = plain.splats.optimiser.parameters
    xyz, rgb = plain.splats.means, (p["sh"].detach()[:, 0] * 0.28209479177387814 + 0.5)
    twin = start(scene, hull, config, hooks=[Bystander((xyz, rgb))])
    twin.load_state_dict({k: v.clone() for k, v in plain.state_dict().items()})
    advance(plain, scene, range(40))
    advance(twin, scene, range(40))
    for name, value in plain.state_dict().items():
        assert torch.equal(value, twin.state_dict()[name]), name


def test_two_hooks_are_a_list_and_removal_is_carried_out(scene, hull):
    class Remover(Bystander):
        def after_step(self, gaussians, step):
            return torch.arange(len(gaussians.means)) < 5

    points = (torch.zeros(0, 3), torch.zeros(0, 3))
    method = start(scene, hull, hooks=[SMALL.vd.build(hull, scene.train), Remover(points)])
    advance(method, scene, range(3))
    assert len(method.splats) == 600 - 15


def test_seeds_differ_and_repeat(scene, hull):
    means = [start(scene, hull, seed=s).splats.optimiser.parameters["means"] for s in (0, 0, 1)]
    assert torch.equal(means[0], means[1]) and not torch.equal(means[0], means[2])


def test_extent_and_colour_agree_with_their_definitions(scene):
    cameras = scene.train.cameras
    mean = sum(cameras.centres) / len(cameras)
    assert scene_extent(cameras) == pytest.approx(
        1.1 * max(float((c - mean).norm()) for c in cameras.centres)
    )
    # A point far behind every camera is seen by none: black.
    assert (mean_masked_colour(torch.full((1, 3), 1e6), scene.train) >= 0).all()
    behind = cameras.centres[0] - 1e3 * cameras.forward[0]
    one = replace(
        scene.train, cameras=cameras[:1], images=scene.train.images[:1], names=scene.train.names[:1]
    )
    assert (mean_masked_colour(behind[None].float(), one) == 0).all()


def test_presets_differ_only_in_what_they_name():
    presets = SPEC.presets()
    bare, mask, vd = (presets["3dgs-go" + variant] for variant in ("", "+mask", "+vd"))
    for budget in ("quick", "full"):
        base = getattr(bare, budget)
        assert replace(getattr(mask, budget), mask_weight=base.mask_weight) == base
        assert getattr(vd, budget).vd.enabled and not base.vd.enabled
        kept = {name: getattr(base, name) for name in ("mask_weight", "hull", "vd", "floater_every")}
        assert replace(getattr(vd, budget), **kept) == base
