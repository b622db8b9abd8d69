"""The soft prior on density from the shape inside the hull."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.synthetic.scene import SyntheticConfig, make_scene
from method_configs import ingp, zerorf_lite, zipnerf_lite
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.inside.shape import shape_inside
from visdom_plugin.methods.fields.shape_prior import MARGIN, ShapePrior
from visdom_plugin.nerf.frame import Frame
from visdom_plugin.training.run import build

METHODS = {
    spec.name: spec.presets()[f"{spec.name}+vd"] for spec in (ingp.SPEC, zerorf_lite.SPEC, zipnerf_lite.SPEC)
}
FRAME = Frame(torch.tensor([3.0, -1, 2], dtype=torch.float64), 0.25)


@pytest.fixture(scope="module")
def balls():
    """A ball of radius 0.6 in one of radius 1, around (3, -1, 2)."""
    radius = np.linalg.norm((np.indices((100,) * 3).transpose(1, 2, 3, 0) + 0.5) / 40 - 1.25, axis=-1)
    bounds = np.array([[1.75, -2.25, 0.75], [4.25, 0.25, 3.25]])
    return Hull(radius < 1, bounds, inner=Hull(radius < 0.6, bounds))


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=40))


@pytest.fixture(scope="module")
def hull(scene):
    hull = VisibleDomain(resolution=40).carve(*scene.train.silhouettes())
    return replace(hull, inner=shape_inside(hull, *scene.train.silhouettes()))


def generator():
    return torch.Generator().manual_seed(0)


def test_it_is_0_for_the_shape_itself_and_1_where_all_is_opaque(balls):
    prior = ShapePrior(balls, FRAME)

    def ball(points):
        return 1e4 * (points.norm(dim=-1) / FRAME.scale < 0.6).float()

    assert float(prior.loss(ball, generator())) < 1e-3
    assert float(prior.loss(lambda p: torch.full((len(p),), 1e4), generator())) == 1
    assert float(ShapePrior(replace(balls, inner=balls), FRAME).loss(ball, generator())) == 0


def test_it_asks_within_the_hull_and_not_near_the_shape(balls):
    seen = []

    def note(points):
        seen.append(points.norm(dim=-1) / FRAME.scale)
        return torch.zeros(len(points))

    ShapePrior(balls, FRAME).loss(note, generator())
    voxel = 0.025 * 3**0.5
    assert (seen[0] < 1 + voxel).all() and (seen[0] > 0.6 + MARGIN - voxel).all()


@pytest.mark.parametrize("name", METHODS)
def test_a_field_follows_it_and_a_resumed_run_does_not_notice(name, scene, hull):
    def start(**changes):
        # Dense from the start, so that thirty steps have something to clear.
        config = replace(METHODS[name].quick, steps=30, density_bias=2.0, **changes)
        return set_up(METHODS[name].load(), config, scene, hull)

    plain, straight, resumed = start(), start(prior_weight=1.0), start(prior_weight=1.0)
    assert plain.prior is None
    advance(plain, scene, range(30))
    advance(straight, scene, range(20))
    resumed.load_state_dict(copy_of(straight))
    advance(straight, scene, range(20, 30))
    advance(resumed, scene, range(20, 30))
    assert same(copy_of(straight), copy_of(resumed))
    with torch.no_grad():
        misfits = [float(straight.prior.loss(m.density, generator())) for m in (plain, straight)]
    assert misfits[1] < 0.97 * misfits[0]


def test_a_run_finds_the_shape_or_says_that_there_is_none(scene, caplog):
    preset = METHODS["ingp"]
    config = replace(preset.quick, steps=2, prior_weight=0.1, hull=VisibleDomain(resolution=40))
    method, _, _ = build(preset, config, scene.train, device=torch.device("cpu"), seed=0)
    assert method.prior is not None
    with caplog.at_level(logging.WARNING):
        two = replace(config, hull=replace(config.hull, k=2))
        method, _, _ = build(preset, two, scene.train.take([0, 2]), device=torch.device("cpu"), seed=0)
    assert method.prior is None and "from 2 views" in caplog.text


@pytest.mark.parametrize("changes", [{"prior_weight": -0.1}, {"prior_weight": 0.1, "hull": None}])
def test_a_weight_below_0_or_without_a_hull_is_refused(changes):
    with pytest.raises(ConfigError, match="prior_weight"):
        replace(ingp.SPEC.quick, **changes)
