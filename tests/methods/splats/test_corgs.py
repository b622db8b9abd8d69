"""corgs-lite: what ties its two sets together, and what must not."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.corgs_lite import SPEC
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import draw_between, look_at_camera
from visdom_plugin.geometry.cameras import Cameras, look_at_point, project
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.corgs_lite import CorgsLite, co_regularisation, unmatched
from visdom_plugin.methods.splats.pseudo_views import draw_on_ellipse, fit_ellipse
from visdom_plugin.seeding import generator
from visdom_plugin.training.batches import DataManager

CPU = torch.device("cpu")
SMALL = replace(
    SPEC.quick,
    steps=60,
    initial_points=500,
    densify_from=8,
    densify_until=50,
    densify_every=6,
    densify_gradient=1e-4,
    opacity_reset_from=31,
    opacity_reset_every=20,
    pseudo_from=4,
    pseudo_until=60,
    co_prune_every=10,
    sh_every=15,
    hull=VisibleDomain(resolution=48),
    vd=RegularizerConfig(enabled=True, prune_every=7),
)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=56))


@pytest.fixture(scope="module")
def hull(scene):
    return SMALL.hull.carve(scene.train.cameras, scene.train.masks)


def start(scene, hull, config=SMALL, hooks=None, seed=0):
    return set_up(CorgsLite, config, scene, hull, hooks, seed)


class Watcher:
    """A hook that changes nothing, and notes how it is called."""

    def __init__(self, points, remove=0):
        self.points, self.remove, self.seen, self.after = points, remove, [], []

    def initial_points(self, n, generator):
        return self.points

    def loss(self, render, step, generator):
        self.seen.append((step, torch.rand(3, generator=generator)))
        return {}

    def after_step(self, gaussians, step):
        self.after.append(len(gaussians.means))
        return torch.arange(len(gaussians.means)) < self.remove if self.remove else None


def test_events_are_those_of_both_sets(scene, hull):
    assert start(scene, hull).events()["opacities reset"] == [31, 51]


def test_it_learns(scene, hull):
    # Without the opacity reset, whose dip sixty steps do not make up for.
    method = start(scene, hull, replace(SMALL, opacity_reset_every=0))

    def error():
        total = 0.0
        for camera, image, mask in zip(
            scene.train.cameras, scene.train.images, scene.train.masks, strict=True
        ):
            truth = torch.where(mask[..., None], image.float() / 255, 1.0)
            total += float((method.render(camera, torch.ones(3)).rgb - truth).square().mean())
        return total

    before = error()
    advance(method, scene, range(60))
    assert error() < 0.85 * before


def test_a_resumed_run_equals_the_uninterrupted_one(scene, hull):
    straight = start(scene, hull)
    advance(straight, scene, range(33))
    saved = copy_of(straight)
    advance(straight, scene, range(33, 60))
    resumed = start(scene, hull)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(33, 60))
    assert same(straight.state_dict(), resumed.state_dict())


def test_the_sets_start_alike_and_part_when_gaussians_split(scene, hull):
    method = start(scene, hull)
    advance(method, scene, range(SMALL.densify_from))
    first, second = (one.state_dict() for one in method.strategies)
    assert same(first, second)
    advance(method, scene, range(SMALL.densify_from, 30))
    first, second = method.sets
    assert not torch.equal(first.means[:100], second.means[:100])


@pytest.mark.parametrize("initial_cloud", ["hull", "random"])
def test_a_hook_that_adds_nothing_changes_nothing(scene, hull, initial_cloud):
    config = replace(SMALL, vd=RegularizerConfig(), initial_cloud=initial_cloud)
    plain = start(scene, hull, config, hooks=[])
    points = plain.sets[0].means.clone(), torch.full((len(plain.sets[0]), 3), 0.5)
    twin = start(scene, hull, config, hooks=[Watcher(points)])
    twin.load_state_dict(copy_of(plain))
    advance(plain, scene, range(30))
    advance(twin, scene, range(30))
    assert same(plain.state_dict(), twin.state_dict())


def test_one_hook_is_called_once_for_each_set_with_the_same_numbers(scene, hull):
    watcher = Watcher((0.1 * torch.rand(200, 3), torch.rand(200, 3)))
    method = start(scene, hull, hooks=[watcher])
    advance(method, scene, range(12))
    assert [step for step, _ in watcher.seen] == [step for step in range(12) for _ in range(2)]
    pairs = list(zip(watcher.seen[::2], watcher.seen[1::2], strict=True))
    assert all(torch.equal(a, b) for (_, a), (_, b) in pairs)
    assert not torch.equal(watcher.seen[0][1], watcher.seen[2][1])
    assert len(watcher.after) == 24


def test_the_visible_domain_shows_both_sets_the_same_view(scene, hull):
    hook, views = SMALL.vd.build(hull, scene.train), []
    inner = hook.loss

    def loss(render, step, draw):
        def watched(camera):
            drawn = render(camera)
            views.append((camera, drawn.alpha.detach()))
            return drawn

        return inner(watched, step, draw)

    hook.loss = loss
    method = start(scene, hull, hooks=[hook])
    advance(method, scene, range(30))
    assert len(views) == 60
    for (a, _), (b, _) in zip(views[::2], views[1::2], strict=True):
        assert torch.equal(a.world_from_camera, b.world_from_camera)
    # And each time it is the other set that is drawn.
    assert not torch.equal(views[-2][1], views[-1][1])


def test_removal_by_a_hook_is_carried_out_in_both_sets(scene, hull):
    watcher = Watcher((0.1 * torch.rand(200, 3), torch.rand(200, 3)), remove=5)
    method = start(scene, hull, hooks=[watcher])
    advance(method, scene, range(3))
    assert [len(one) for one in method.sets] == [200 - 15, 200 - 15]


def test_co_regularisation_moves_each_set_by_its_own_loss_alone():
    images = [torch.rand(24, 20, 3, generator=generator(0, i), requires_grad=True) for i in range(2)]
    losses = co_regularisation(*images, ssim_weight=0.2, weight=0.7)
    for i in range(2):
        own, other = torch.autograd.grad(losses[f"co_{i}"], (images[i], images[1 - i]), allow_unused=True)
        assert other is None and own.abs().sum() > 0
    swapped = co_regularisation(*images[::-1], ssim_weight=0.2, weight=0.7)
    assert torch.equal(losses["co_0"], swapped["co_1"]) and torch.equal(losses["co_1"], swapped["co_0"])


def test_in_training_no_gradient_crosses_from_one_set_to_the_other(scene, hull):
    config = replace(SMALL, pseudo_from=0)
    method = start(scene, hull, config)
    advance(method, scene, range(20))  # until they differ
    batch = DataManager(scene.train, seed=0).view_batch(20)
    losses = method.train_step(batch, 20).losses
    assert {"co_0", "co_1", "visdom_outside_0", "visdom_outside_1"} <= losses.keys()
    for name, value in losses.items():
        own = int(name[-1])
        p = [one.optimiser.parameters["means"] for one in method.sets]
        gradients = torch.autograd.grad(value, p, allow_unused=True, retain_graph=True)
        assert gradients[1 - own] is None, name
        assert gradients[own] is not None, name


def test_pseudo_views_end_when_they_should(scene, hull):
    config = replace(SMALL, pseudo_from=3, pseudo_until=9, pseudo_every=3, vd=RegularizerConfig())
    method = start(scene, hull, config)
    data, found = DataManager(scene.train, seed=0), []
    for step in range(14):
        output = method.train_step(data.view_batch(step), step)
        output.total.backward()
        method.optimise(step, output)
        if "co_0" in output.losses:
            found.append(step + 1)
    assert found == [3, 6, 9]


def brute_force(a, b, distance):
    squared = (a[:, None].double() - b[None].double()).square().sum(-1)
    return squared.amin(1).sqrt() > distance, squared.amin(0).sqrt() > distance


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.integers(1, 60), st.floats(1e-3, 2.0), st.integers(0, 10**6))
def test_co_pruning_equals_brute_force_in_both_directions(n, m, distance, seed):
    draw = generator(seed)
    a, b = torch.randn(n, 3, generator=draw), torch.randn(m, 3, generator=draw)
    found, twin = unmatched(a, b, distance), brute_force(a, b, distance)
    assert all(torch.equal(x, y) for x, y in zip(found, twin, strict=True))
    assert all(torch.equal(x, y) for x, y in zip(unmatched(b, a, distance), found[::-1], strict=True))
    # All alone on one side means all alone on the other.
    assert bool(found[0].all()) == bool(found[1].all())


def test_co_pruning_removes_strays_of_either_set_and_never_a_whole_set(scene, hull):
    config = replace(SMALL, vd=RegularizerConfig(), co_prune_world=0.5)
    method = start(scene, hull, config, hooks=[])
    first, second = method.sets
    n = len(first)
    means = [one.gaussians().means.detach().clone() for one in method.sets]
    means[0][3] += 50
    means[1][7] -= 50
    for one, x in zip(method.sets, means, strict=True):
        one.optimiser.overwrite("means", x)
    method._co_prune(10)
    # A stray's old partner has others nearby; the strays themselves have none.
    assert len(first) == len(second) == n - 1
    assert float(first.means.abs().max()) < 40 and float(second.means.abs().max()) < 40
    second.optimiser.overwrite("means", second.gaussians().means.detach() + 100)
    method._co_prune(20)
    assert len(first) == len(second) == n - 1


def test_the_threshold_scales_with_the_scene_unless_it_is_in_world_units(scene, hull):
    cameras = scene.train.cameras
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] *= 3
    larger = replace(scene.train, cameras=replace(cameras, world_from_camera=motion))
    for config, factor in (
        (SMALL, 3),
        (replace(SMALL, co_prune_world=0.25), 1),
    ):
        distances = []
        for views in (scene.train, larger):
            method = CorgsLite(replace(config, initial_cloud="random"))
            method.setup(views, [], hull=None, device=CPU, seed=0)
            distances.append(method.co_prune_distance * method.unit)
        assert distances[1] == pytest.approx(factor * distances[0])


def ring(n, half_axes, height, rotation=None):
    """Cameras on an ellipse that look at the origin, in a frame of any rotation."""
    angle = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n) + 0.1
    centres = torch.stack(
        [
            half_axes[0] * angle.cos(),
            half_axes[1] * angle.sin(),
            torch.full_like(angle, height) + 0.2 * (3 * angle).cos(),
        ],
        -1,
    )
    motion = look_at_camera(centres, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1]).double())
    if rotation is not None:
        motion = rotation @ motion
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], dtype=torch.float64)
    return Cameras.from_matrices(K, motion, width=64, height=48)


def test_the_ellipse_is_the_published_one():
    cameras = ring(40, (4.0, 2.5), 1.0)
    ellipse = fit_ellipse(cameras)
    offsets = (cameras.centres - look_at_point(cameras))[:, :2].abs()
    expected = [sorted(offsets[:, i].tolist()) for i in range(2)]
    # The 90th percentile of 40 values lies between the 36th and the 37th.
    for x, values in zip(ellipse.half_axes.tolist(), expected, strict=True):
        assert values[35] - 1e-9 <= x <= values[36] + 1e-9
    for angle in torch.linspace(0, 6.2, 9):
        camera = ellipse.camera(angle)
        uv, depth = project(camera, look_at_point(cameras)[None])
        torch.testing.assert_close(uv[0], torch.tensor([32.0, 24.0]).double())
        assert depth[0] > 0
        position = (camera.centres - look_at_point(cameras)) / torch.cat([ellipse.half_axes, torch.ones(1)])
        assert float(position[:2].norm()) == pytest.approx(1, abs=1e-6)
        # Heights keep a tenth of the cameras' own spread about their mean.
        assert abs(float(camera.centres[2] - cameras.centres[:, 2].mean())) <= 0.1 * 0.2 + 1e-9
        # Upright: the image's down axis points down.
        assert float(camera.world_from_camera[2, 1]) < -0.5


def test_the_ellipse_moves_with_the_world():
    rotation = torch.eye(4, dtype=torch.float64)
    rotation[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator(3), dtype=torch.float64))[0]
    rotation[:3, :3] *= torch.linalg.det(rotation[:3, :3])
    rotation[:3, 3] = torch.tensor([5.0, -2.0, 1.0])
    still, moved = fit_ellipse(ring(40, (4.0, 2.5), 1.0)), fit_ellipse(ring(40, (4.0, 2.5), 1.0, rotation))
    angles = torch.arange(8) * (math.pi / 4)
    a = torch.stack([rotation[:3, :3] @ still.camera(t).centres + rotation[:3, 3] for t in angles])
    b = torch.stack([moved.camera(t).centres for t in angles])
    # Axes have no sign: the same points, perhaps from another start; heights go with the cosine of the angle.
    nearest = (a[:, None] - b[None]).norm(dim=-1).amin(1)
    assert float(nearest.max()) < 0.05


def test_pseudo_views_repeat_by_step_and_vary_between_steps(scene, hull):
    for kind in ("ellipse", "between"):
        method = start(scene, hull, replace(SMALL, pseudo_views=kind))
        a, b, c = (method.pseudo_camera(step).world_from_camera for step in (5, 5, 6))
        assert torch.equal(a, b) and not torch.equal(a, c)


def test_views_between_cameras_see_the_look_at_point_no_farther_than_their_ends(scene):
    cameras = scene.train.cameras
    target = look_at_point(cameras)
    depths = project(cameras, target.expand(len(cameras), 1, 3))[1]
    for seed in range(12):
        depth = project(draw_between(cameras, target, generator(seed)), target[None])[1]
        assert depths.min() - 1e-6 <= depth[0] <= depths.max() + 1e-6
        assert draw_on_ellipse(fit_ellipse(cameras), generator(seed)).shape == ()


def test_one_view_is_refused(scene, hull):
    one = scene.train.cameras[:1]
    views = replace(
        scene.train,
        cameras=one,
        images=scene.train.images[:1],
        masks=scene.train.masks[:1],
        names=scene.train.names[:1],
    )
    with pytest.raises(SceneError, match="views 2"):
        CorgsLite(SMALL).setup(views, [], hull=hull, device=CPU, seed=0)


def test_presets_differ_only_in_what_they_name():
    bare, mask, vd = (SPEC.presets()[f"corgs{suffix}"] for suffix in ("", "+mask", "+vd"))
    assert SPEC.presets()["corgs-lite+vd"] == vd
    for budget in ("quick", "full"):
        base = getattr(bare, budget)
        assert replace(getattr(mask, budget), mask_weight=base.mask_weight) == base
        assert getattr(vd, budget).vd.enabled and not base.vd.enabled
        kept = {name: getattr(base, name) for name in ("mask_weight", "hull", "vd")}
        assert replace(getattr(vd, budget), **kept) == base
