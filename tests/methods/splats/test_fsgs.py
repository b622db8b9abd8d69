"""fsgs-lite: where it grows Gaussians, and what it holds their depth to."""

import logging
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.fsgs_lite import SPEC
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.fsgs.depth import DepthProvider, of_disparity, of_map, pearson
from visdom_plugin.methods.splats.fsgs.method import FsgsLite
from visdom_plugin.seeding import generator
from visdom_plugin.specs import check_requirements
from visdom_plugin.splat.densify import Proximity, unpooled
from visdom_plugin.training.batches import DataManager

CPU = torch.device("cpu")
SMALL = replace(
    SPEC.quick,
    steps=60,
    initial_points=400,
    densify_from=8,
    densify_until=50,
    densify_every=6,
    densify_gradient=1e-4,
    opacity_reset_from=31,
    opacity_reset_every=20,
    unpool_until=30,
    depth_until=50,
    pseudo_from=4,
    pseudo_until=50,
    pseudo_every=3,
    pseudo_ramp=10,
    sh_every=15,
    hull=VisibleDomain(resolution=48),
    vd=RegularizerConfig(enabled=True, prune_every=7),
)
NETWORK = "depth_network_of_a_test:predict"


@pytest.fixture(scope="module")
def scene():
    """A scene with depth maps whose upper left corner is unknown."""
    made = make_scene(SyntheticConfig(size=56))
    maps = []
    for i, image in enumerate(made.train.images):
        depth = 2 + torch.rand(image.shape[:2], generator=generator(0, "depth", i))
        depth[:5, :5] = 0
        maps.append(depth)
    return replace(made, train=replace(made.train, mono_depths=tuple(maps)))


@pytest.fixture(scope="module")
def hull(scene):
    return SMALL.hull.carve(scene.train.cameras, scene.train.masks)


@pytest.fixture
def network(monkeypatch):
    """A module whose `predict` can be replaced."""
    module = ModuleType("depth_network_of_a_test")
    module.predict = lambda image: 300 - 100 * image.mean(-1)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


def start(scene, hull, config=SMALL, hooks=None):
    return set_up(FsgsLite, config, scene, hull, hooks)


def brute_force(means):
    """Root mean squared distances to the three nearest other points."""
    squared = (means[:, None] - means[None]).double().square().sum(-1).fill_diagonal_(torch.inf)
    return squared.topk(3, largest=False).values.mean(-1).sqrt()


@settings(max_examples=40, deadline=None)
@given(st.integers(4, 40), st.integers(0, 20), st.integers(0, 10**6))
def test_proximity_equals_brute_force_also_where_points_coincide(n, copies, seed):
    draw = generator(seed)
    means = torch.randn(n, 3, generator=draw)
    means = torch.cat([means, means[torch.randint(n, (copies,), generator=draw)]])
    found = Proximity.of(means)
    torch.testing.assert_close(found.score.double(), brute_force(means), rtol=1e-4, atol=1e-6)
    distances = (means[:, None] - means[found.nearest]).norm(dim=-1)
    torch.testing.assert_close(distances.square().mean(-1).sqrt(), found.score, rtol=1e-4, atol=1e-6)
    # Five of one place may not see that one of them is the point itself.
    alone = (means[:, None] == means[None]).all(-1).sum(-1) <= 4
    assert not bool((found.nearest[alone] == torch.arange(len(means))[alone, None]).any())


@settings(max_examples=25, deadline=None)
@given(st.integers(4, 40), st.integers(0, 10**6))
def test_unpooling_puts_grey_gaussians_halfway_to_each_neighbour(n, seed):
    draw = generator(seed)
    rows = {
        "means": torch.randn(n, 3, generator=draw),
        "log_scales": torch.randn(n, 3, generator=draw),
        "quaternions": torch.randn(n, 4, generator=draw),
        "opacity_logits": torch.randn(n, generator=draw),
        "sh": torch.randn(n, 4, 3, generator=draw),
    }
    before = {name: value.clone() for name, value in rows.items()}
    proximity = Proximity.of(rows["means"])
    lonely = torch.rand(n, generator=draw) < 0.5
    new = unpooled(rows, proximity, lonely)
    assert same(before, rows)
    assert all(len(value) == 3 * int(lonely.sum()) for value in new.values())
    k = 0
    for i in lonely.nonzero()[:, 0].tolist():
        for j in proximity.nearest[i].tolist():
            torch.testing.assert_close(new["means"][k], (rows["means"][i] + rows["means"][j]) / 2)
            assert torch.equal(new["log_scales"][k], rows["log_scales"][j])
            assert new["opacity_logits"][k] == rows["opacity_logits"][j]
            k += 1
    assert not bool(new["sh"].any())
    assert bool((new["quaternions"] == torch.tensor([1.0, 0, 0, 0])).all())


def test_lonely_and_large_gaussians_grow_three_until_the_last_step_and_the_limit(scene, hull):
    # No gradient is enough for densification of the usual kind, and nothing is removed. It is due at 12, 18, 24.
    still = replace(
        SMALL,
        densify_gradient=1.0,
        prune_opacity=0.0,
        unpool_distance=0.005,
        unpool_scale=0.001,
        unpool_split_distance=9.0,
        max_gaussians=5_000,
    )

    def grown(**changes):
        method = start(scene, hull, replace(still, **changes), hooks=[])
        advance(method, scene, range(25))
        return len(method.splats)

    assert grown(unpool_until=18) == grown(max_gaussians=1_000) == 4 * 400
    assert 8 * 400 < grown() <= 16 * 400  # the last time it was due there were too many
    assert grown(unpool_until=0) == grown(unpool_distance=1.0) == grown(unpool_scale=1.0) == 400
    # Splitting of what is far apart knows no last step.
    assert grown(unpool_until=0, unpool_split_distance=0.005) > 400


@settings(max_examples=50, deadline=None)
@given(
    st.integers(3, 200),
    st.floats(1e-2, 1e2),
    st.floats(-3, 3),
    st.integers(0, 10**6),
)
def test_pearson_knows_neither_scale_nor_shift(n, scale, shift, seed):
    draw = generator(seed)
    a, b = torch.randn(2, n, generator=draw, dtype=torch.float64)
    weight = torch.rand(n, generator=draw, dtype=torch.float64)
    r = pearson(a, b, weight)
    assert abs(float(r)) <= 1 + 1e-9
    torch.testing.assert_close(pearson(b, a, weight), r)
    torch.testing.assert_close(pearson(scale * a + shift, b, weight), r, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(pearson(-scale * a + shift, b, weight), -r, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(pearson(a, b, 7 * weight), r)
    torch.testing.assert_close(pearson(a, 2 * a, weight), torch.ones_like(r))
    expected = np.cov(a, b, aweights=weight)
    assert float(r) == pytest.approx(expected[0, 1] / (expected[0, 0] * expected[1, 1]) ** 0.5, abs=1e-6)


def test_pearson_asks_nothing_of_pixels_without_weight_and_of_flat_pictures():
    a, b = torch.randn(2, 50, generator=generator(0))
    weight = (torch.arange(50) < 30).float()
    wild = torch.where(weight > 0, a, 1e3)
    torch.testing.assert_close(pearson(wild, b, weight), pearson(a[:30], b[:30], torch.ones(30)))
    for x, w in ((torch.ones(50), torch.ones(50)), (a, torch.zeros(50))):
        x = x.clone().requires_grad_()
        r = pearson(x, b, w)
        r.backward()
        assert float(r.detach()) == pytest.approx(0, abs=1e-5) and bool(x.grad.isfinite().all())


def test_monocular_depth_has_no_unit():
    depth = 1 + torch.rand(9, 7, generator=generator(1))
    depth[0, 0] = 0
    for reading, value in ((of_map, depth), (of_disparity, depth[1:])):
        a, b = reading(value), reading(1024 * value)
        assert torch.equal(a.forms, b.forms) and torch.equal(a.known, b.known)
        # Both readings of it say which of two pixels is farther.
        near_first = (depth[1:] if reading is of_map else -depth[1:]).flatten().argsort()
        forms = a.forms[:, 1:] if reading is of_map else a.forms
        for form in forms:
            assert bool((form.flatten()[near_first].diff() >= 0).all())
    assert of_map(depth).known[0, 0] == 0 and of_map(depth).known.sum() == depth.numel() - 1


def test_the_depth_loss_pulls_the_renders_depth_towards_the_maps(scene, hull):
    """Steps of the depth loss alone raise the correlation."""
    method = start(scene, hull, replace(SMALL, vd=RegularizerConfig()), hooks=[])
    data, found = DataManager(scene.train, seed=0), []
    for step in range(8):
        losses = method.train_step(data.view(0), step).losses
        found.append(float(losses["depth"].detach()))
        losses["depth"].backward()
        with torch.no_grad():
            method.splats.optimise(step)
    assert found[-1] < found[0] - 1e-5 and 0 <= found[-1] <= 2 * SMALL.depth_weight


def test_the_weight_of_depth_falls_when_it_should(scene, hull):
    method = start(scene, hull, replace(SMALL, depth_until=2, depth_weight_late=SMALL.depth_weight / 4))
    data = DataManager(scene.train, seed=0)
    early, late = (float(method.train_step(data.view(0), step).losses["depth"].detach()) for step in (1, 2))
    assert late == pytest.approx(early / 4, rel=0.05)
    off = start(scene, hull, replace(SMALL, depth_weight=0.0, depth_weight_late=0.0))
    assert "depth" not in off.train_step(data.view(0), 0).losses


def test_pseudo_views_come_when_they_should_and_grow_in_weight(scene, hull, network):
    config = replace(SMALL, depth_network=NETWORK, pseudo_from=3, pseudo_until=15, pseudo_ramp=8)
    method = start(scene, hull, config)
    data, found = DataManager(scene.train, seed=0), {}
    for step in range(20):
        losses = method.train_step(data.view_batch(step), step).losses
        if "pseudo_depth" in losses:
            found[step + 1] = float(losses["pseudo_depth"].detach())
    assert list(found) == [6, 9, 12, 15]  # at step 3 the weight is still 0
    assert 0 < found[6] < found[15]
    assert all(value <= 2 * config.pseudo_weight for value in found.values())


def test_gradients_flow_through_the_network_and_into_the_depth(scene, hull, network):
    config = replace(SMALL, depth_network=NETWORK, pseudo_from=0, pseudo_every=1)
    method = start(scene, hull, config)
    loss = method.train_step(DataManager(scene.train, seed=0).view(0), 20).losses["pseudo_depth"]
    loss.backward(retain_graph=True)
    with_network = method.splats.optimiser.parameters["sh"].grad.abs().sum()
    assert with_network > 0  # colours reach the loss through the network alone
    assert method.splats.optimiser.parameters["means"].grad.abs().sum() > 0


def test_the_network_sees_each_photograph_once_and_wins_over_the_maps(scene, hull, network):
    seen = []
    network.predict = lambda image: (seen.append(image.clone()), image.mean(-1))[1]
    method = start(scene, hull, replace(SMALL, depth_network=NETWORK, pseudo_every=0))
    advance(method, scene, range(3))
    assert len(seen) == len(scene.train)
    assert all(torch.equal(a, image.float() / 255) for a, image in zip(seen, scene.train.images, strict=True))


def test_without_maps_and_network_depth_is_off_and_the_run_says_so_once(scene, hull, caplog):
    bare = replace(scene, train=replace(scene.train, mono_depths=()))
    with caplog.at_level(logging.INFO):
        method = start(bare, hull)
        advance(method, bare, range(12))
    assert sum("without depth" in r.getMessage() for r in caplog.records) == 1
    losses = method.train_step(DataManager(bare.train, seed=0).view(0), 12).losses
    assert not {"depth", "pseudo_depth"} & losses.keys()
    caplog.clear()
    with caplog.at_level(logging.INFO):
        start(scene, hull)
    assert sum("no pseudo views" in r.getMessage() for r in caplog.records) == 1


def test_a_map_that_is_missing_for_some_views_is_refused(scene, hull):
    maps = list(scene.train.mono_depths)
    maps[1] = None
    lacking = replace(scene, train=replace(scene.train, mono_depths=tuple(maps)))
    with pytest.raises(SceneError, match=f"there is none for .*{scene.train.names[1]}"):
        start(lacking, hull)


@pytest.mark.parametrize(
    ("predict", "said"),
    [
        (lambda image: image, "returned .* for a picture of shape"),
        (lambda image: image.mean(-1)[1:], "returned .* for a picture of shape"),
        (lambda image: image.mean(-1).numpy(), "returned ndarray"),
        (lambda image: image.mean(-1) * torch.nan, "not finite for the photograph"),
        ("a text", "is str, not a function"),
    ],
)
def test_a_network_that_answers_otherwise_is_named(scene, network, predict, said):
    network.predict = predict
    with pytest.raises(ConfigError, match=said) as refused:
        DepthProvider(scene.train, NETWORK, CPU)
    assert NETWORK in refused.value.where


@pytest.mark.parametrize("target", ["no_such_module_at_all:predict", "math:no_such_function"])
def test_a_network_that_is_not_there_is_named(scene, target):
    with pytest.raises(ConfigError, match="cannot be loaded") as refused:
        DepthProvider(scene.train, target, CPU)
    assert target in refused.value.where
    with pytest.raises(ConfigError, match="cannot be loaded"):
        check_requirements(replace(SMALL, depth_network=target))
    check_requirements(SMALL)


@pytest.mark.parametrize("with_network", [False, True])
def test_a_resumed_run_equals_the_uninterrupted_one(scene, hull, network, with_network):
    config = replace(SMALL, depth_network=NETWORK) if with_network else SMALL
    straight = start(scene, hull, config)
    advance(straight, scene, range(27))
    saved = copy_of(straight)
    advance(straight, scene, range(27, 45))
    resumed = start(scene, hull, config)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(27, 45))
    assert same(straight.state_dict(), resumed.state_dict())


def test_depth_changes_nothing_but_by_its_loss(scene, hull):
    """With weight 0 the maps leave no trace."""
    bare = replace(scene, train=replace(scene.train, mono_depths=()))
    off = replace(SMALL, depth_weight=0.0, depth_weight_late=0.0)
    states = []
    for data, config in ((bare, SMALL), (scene, off)):
        method = start(data, hull, config)
        advance(method, data, range(20))
        states.append(copy_of(method))
    assert same(*states)


def test_presets_differ_only_in_what_they_name():
    bare, mask, vd = (SPEC.presets()[f"fsgs{suffix}"] for suffix in ("", "+mask", "+vd"))
    assert SPEC.presets()["fsgs-lite+vd"] == vd
    for budget in ("quick", "full"):
        base = getattr(bare, budget)
        assert replace(getattr(mask, budget), mask_weight=base.mask_weight) == base
        kept = {name: getattr(base, name) for name in ("mask_weight", "hull", "vd")}
        assert replace(getattr(vd, budget), **kept) == base and getattr(vd, budget).vd.enabled
