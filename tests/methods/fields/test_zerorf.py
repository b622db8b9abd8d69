"""ZeroRF lite: its cube, its schedule, its loss, and that the networks are asked once a step."""

import logging
from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs import zerorf_lite
from tests.methods.fields.test_nerf_methods import SMALL
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin import registry
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.methods.fields.common import photograph_on
from visdom_plugin.methods.fields.zerorf_lite import ZeroRfLite, fit_cube
from visdom_plugin.nerf.optimiser import FieldOptimiser
from visdom_plugin.nerf.sampling.occupancy_grid import OccupancyGrid, intersect_cube
from visdom_plugin.training.batches import DataManager

BARE = replace(SMALL[ZeroRfLite], mask_weight=0.0, hull=None, vd=zerorf_lite.SPEC.quick.vd)
REPRESENTATIONS = pytest.mark.parametrize("representation", ["tensorf", "dif"])


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48))


def start(scene, seed=0, **changes):
    return set_up(ZeroRfLite, replace(BARE, **changes), scene, None, hooks=[], seed=seed)


def test_every_ray_of_the_object_meets_the_cube_and_the_cube_is_no_larger_than_it_must_be(scene):
    views = scene.train
    frame, tight = fit_cube(views, 0.1), fit_cube(views, 0.0)
    assert frame.scale * 1.1 == pytest.approx(tight.scale)
    for i in range(len(views)):
        rays = rays_of(views.cameras[i])
        origins, directions = (
            x[views.masks[i]].float() for x in (frame.to_local(rays.origins), rays.directions)
        )
        enter, leave = intersect_cube(origins, directions, 1.0)
        assert (enter < leave).float().mean() > 0.98
    # A cube a third smaller would lose some of it.
    lost = []
    for i in range(len(views)):
        rays = rays_of(views.cameras[i])
        local = tight.to_local(rays.origins)[views.masks[i]] * 1.5
        enter, leave = intersect_cube(local, rays.directions[views.masks[i]].float(), 1.0)
        lost.append(float((enter >= leave).float().mean()))
    assert max(lost) > 0.02


def test_without_a_hull_the_cube_reaches_half_way_to_the_cameras_and_the_run_says_so(scene, caplog):
    views = scene.train
    empty = replace(views, masks=[torch.zeros_like(m) for m in views.masks])
    with caplog.at_level(logging.WARNING):
        frame = fit_cube(empty, 0.1)
    distances = (views.cameras.centres.double() - frame.centre).norm(dim=-1)
    assert float(distances.mean()) * frame.scale == pytest.approx(2)
    assert "half way to the cameras" in caplog.text


def test_rays_grow_by_the_geometric_mean(scene):
    config = zerorf_lite.SPEC.full
    method = ZeroRfLite(config)
    counts = [method.pixels_per_step(step) for step in (0, 49, 50, 99, 100, 9_999)]
    assert counts == [2**12, 2**12, 2**14, 2**14, 2**16, 2**16] and method.total_steps == 10_000


def test_full_is_the_published_schedule():
    full = registry.find("zerorf").full
    assert (full.lr, full.betas, full.weight_decay, full.gradient_clip) == (0.002, (0.9, 0.98), 0.2, 1.0)
    assert (full.noise_channels, full.noise_resolution, full.mse_weight) == (8, 20, 3.2)
    assert (full.occupancy_resolution, full.occupancy_density, full.test_occupancy_density) == (
        64,
        0.05,
        0.01,
    )
    assert full.background == "white" and full.dif_period == 0.4 and full.compare_alpha
    # As many samples along the cube's diagonal, at most, as there.
    assert 2 * 3**0.5 / full.step_length == pytest.approx(1024, rel=0.01)


def test_the_loss_is_the_mean_square_over_colours_and_opacity(scene):
    batch = DataManager(scene.train, 0).pixel_batch(0, 64)
    for alpha in (False, True):
        method = start(scene, compare_alpha=alpha)
        with torch.no_grad(), method._make_once():
            drawn = method.draw(batch, 0)
        target = photograph_on(drawn.background, batch, drawn.alpha)
        channels = [drawn.rgb - target] + [(drawn.alpha - batch.mask)[:, None]] * alpha
        # The occupancy grid is brought up to date from the same numbers again.
        losses = start(scene, compare_alpha=alpha).train_step(batch, 0).losses
        assert losses.keys() == {"colour"}
        wanted = 3.2 * torch.cat(channels, -1).square().mean()
        torch.testing.assert_close(losses["colour"].detach(), wanted, rtol=1e-3, atol=0)


def test_opacity_is_compared_with_known_masks_only(scene):
    batch = DataManager(scene.train, 0).pixel_batch(0, 64)
    unknown = replace(batch, mask_known=torch.zeros(64, dtype=torch.bool))
    one, other = (
        start(scene).train_step(replace(unknown, mask=mask), 0).losses["colour"]
        for mask in (batch.mask, 1 - batch.mask)
    )
    assert torch.equal(one, other)


@REPRESENTATIONS
def test_the_networks_are_asked_once_for_a_step_a_picture_and_a_mesh(scene, representation, monkeypatch):
    method = start(scene, representation=representation)
    calls = []
    make = method.factors.make
    monkeypatch.setattr(method.factors, "make", lambda: calls.append(1) or make())
    method.train_step(DataManager(scene.train, 0).pixel_batch(0, 64), 0)
    assert len(calls) == 1
    method.render(scene.test.cameras[0], torch.ones(3))
    assert len(calls) == 2
    method.mesh(16)
    assert len(calls) == 3


@REPRESENTATIONS
def test_a_resumed_run_equals_the_uninterrupted_one_and_brings_its_noise(scene, representation):
    straight = start(scene, representation=representation)
    advance(straight, scene, range(6))
    saved = copy_of(straight)
    # Another seed's noise and weights are overwritten; its batches and jitter are not part of the state.
    resumed = start(scene, representation=representation, seed=7)
    resumed.load_state_dict(saved)
    assert same(copy_of(resumed), saved)
    camera, white = scene.test.cameras[0], torch.ones(3)
    assert torch.equal(resumed.render(camera, white).rgb, straight.render(camera, white).rgb)
    resumed = start(scene, representation=representation)
    resumed.load_state_dict(saved)
    for method in (straight, resumed):
        advance(method, scene, range(6, 10))
    assert same(copy_of(straight), copy_of(resumed))


def test_samples_that_weigh_nothing_are_left_out_and_nobody_sees_it(scene):
    trained = start(scene)
    advance(trained, scene, range(40))
    batch = DataManager(scene.train, 0).pixel_batch(41, 200)
    drawn = {}
    for cull in (0.0, 1e-4, 0.5):
        method = start(scene, cull_weight=cull)
        method.load_state_dict(copy_of(trained))
        drawn[cull] = method.draw(batch, 41)
    assert drawn[0.5].samples < drawn[1e-4].samples <= drawn[0.0].samples
    # A ray has fewer samples than fit into the cube's diagonal.
    most = 1e-4 * 2 * 3**0.5 / BARE.step_length
    assert (drawn[1e-4].alpha - drawn[0.0].alpha).abs().max() < 1.1 * most


def test_a_looser_grid_holds_the_tighter_one():
    grid = OccupancyGrid(8, 1.0, 0.5)
    assert grid.loosened(0.1).occupied.all(), "before the first update all cells count"
    grid.update(lambda p: p.norm(dim=-1), torch.Generator().manual_seed(0), fraction=1.0)
    loose = grid.loosened(0.1)
    assert (loose.occupied | ~grid.occupied).all() and loose.occupied.sum() > grid.occupied.sum()
    assert loose.density is grid.density and grid.threshold == 0.5


def test_the_optimiser_is_clipped_adam_with_decoupled_decay():
    draw = torch.Generator().manual_seed(0)
    mine, theirs = ({k: torch.nn.Parameter(torch.ones(5)) for k in "ab"} for _ in range(2))
    optimiser = FieldOptimiser([(mine, 0.2)], betas=(0.9, 0.98), eps=1e-8, decoupled=True, clip=1.0)
    adam = torch.optim.AdamW(theirs.values(), lr=0.01, betas=(0.9, 0.98), eps=1e-8, weight_decay=0.2)
    for scale in (0.01, 10.0, 1.0):
        for k in "ab":
            mine[k].grad = scale * torch.randn(5, generator=draw)
            theirs[k].grad = mine[k].grad.clone()
        norm = float(torch.cat([p.grad for p in theirs.values()]).norm())
        for p in theirs.values():
            p.grad *= min(1.0, 1 / norm)
        adam.step()
        optimiser.step(0.01)
        for k in "ab":
            torch.testing.assert_close(mine[k], theirs[k])
            assert mine[k].grad is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"noise_resolution": 1},
        {"rays_grow_at": (100, 50)},
        {"test_occupancy_density": 0.1},
        {"cull_weight": 1.0},
        {"betas": (0.9, 1.0)},
        {"gradient_clip": 0.0},
        {"dif_period": 0.0},
        {"fit_margin": -0.1},
    ],
)
def test_settings_out_of_range_are_named(wrong):
    (name,) = wrong
    with pytest.raises(ConfigError, match=f"{name} = .*(?s:.)*--method.{name.replace('_', '-')}"):
        replace(BARE, **wrong)
