"""Refined poses: nearer to the truth, never worse, the same in any frame and with any number of threads."""

import numpy as np
import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.geometry.pointing import pointing_error
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.outlines.distance_fields import Outlines, draw_outlines
from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence
from visdom_plugin.hull.refine.poses import RefineConfig, refine_poses, rotations
from visdom_plugin.hull.refine.rays import assemble, cost_of, find_points, outline_pixels, pack


def scene(views: int, degrees: float, seed: int = 0, size: int = 100):
    config = SyntheticConfig(
        size=size, train_views=views, test_views=0, seed=seed, rotation_noise_deg=degrees, background="black"
    )
    return make_scene(config)


@pytest.fixture(scope="module")
def noisy():
    return scene(6, 1.0)


@pytest.fixture(scope="module")
def outlines(noisy) -> Outlines:
    return draw_outlines(noisy.train.cameras, gather_silhouettes(noisy.train.cameras, noisy.train.masks))


@pytest.fixture(scope="module")
def points(outlines):
    ball = measure_coherence(outlines, 64, power=False).ball
    view, uv = outline_pixels(outlines, 60)
    return find_points(pack(outlines), view, uv, ball)


def moved(outlines: Outlines, change: np.ndarray, distance: np.ndarray) -> Outlines:
    turns, moves = change.reshape(len(outlines), 2, 3).transpose(1, 0, 2)
    return Outlines(
        outlines.rotations @ rotations(turns),
        outlines.centres + distance[:, None] * moves,
        outlines.intrinsics,
        outlines.fields,
    )


def slow_miss(outlines: Outlines, view: int, uv: np.ndarray, depth: float) -> np.ndarray:
    """How far outside each other mask the point lies, by the definition; -inf where a view says nothing."""
    K, R, c = outlines.intrinsics[view], outlines.rotations[view], outlines.centres[view]
    ray = np.linalg.solve(K, [*uv, 1.0])
    x = c + depth * (R @ ray) / np.linalg.norm(ray)
    out = np.full(len(outlines), -np.inf)
    for j, field in enumerate(outlines.fields):
        y = outlines.rotations[j].T @ (x - outlines.centres[j])
        h, w = field.shape
        if j == view or y[2] <= 0:
            continue
        u, v, _ = outlines.intrinsics[j] @ (y / y[2])
        edge = min(u, w - u, v, h - v)
        if edge <= 0:
            continue
        a, b = np.clip(u - 0.5, 0, w - 1.001), np.clip(v - 0.5, 0, h - 1.001)
        k, m = int(b), int(a)
        corners = field[k : k + 2, m : m + 2].astype(float)
        value = np.array([1 - b + k, b - k]) @ corners @ np.array([1 - a + m, a - m])
        q = min(edge / (0.06 * max(w, h)), 1)
        out[j] = value * q * q * (3 - 2 * q) if value > 0 else value
    return out


def test_points_lie_where_the_masks_agree_best(outlines, points):
    rays, miss = points
    for p in range(0, len(rays.view), 7):
        mine = slow_miss(outlines, rays.view[p], rays.uv[p], rays.depth[p])
        assert max(mine.max(), -1e3) == pytest.approx(miss[p], abs=1e-6)
        # No other depth that as many views see is much better.
        for depth in rays.depth[p] * np.linspace(0.8, 1.2, 41):
            other = slow_miss(outlines, rays.view[p], rays.uv[p], depth)
            if min(np.isfinite(other).sum(), 3) >= min(np.isfinite(mine).sum(), 3):
                assert other.max() > miss[p] - 0.75


def test_the_cost_is_the_sum_of_soft_hinges(outlines, points):
    rays, _ = points
    softness, expected = 0.5, 0.0
    for view, uv, depth in zip(*rays, strict=True):
        miss = slow_miss(outlines, view, uv, depth)
        soft = softness * np.logaddexp(0, miss[miss >= -12 * softness] / softness)
        expected += np.where(soft <= 4, soft**2 / 2, 4 * (soft - 2)).sum()
    assert cost_of(pack(outlines), rays, np.ones(6), softness) == pytest.approx(expected, rel=1e-6)


def test_the_gradient_is_that_of_the_cost(outlines, points):
    rays, _ = points
    distance = np.linspace(2.0, 4.0, 6)
    # With depths as they are: damped so much that none moves.
    system = assemble(pack(outlines), rays, distance, 1.0, 1e12)
    for k in range(36):
        step = np.zeros(36)
        step[k] = 1e-5
        up, down = (cost_of(pack(moved(outlines, s * step, distance)), rays, distance, 1.0) for s in (1, -1))
        assert system.vector[k] == pytest.approx(
            (up - down) / 2e-5, rel=0.02, abs=2e-3 * abs(system.vector).max()
        )


def test_depths_are_eliminated(outlines, points):
    """Where each depth moves along as the system says, the cost changes by the reduced gradient."""
    rays, _ = points
    distance = np.linspace(2.0, 4.0, 6)
    free, held = (assemble(pack(outlines), rays, distance, 1.0, d) for d in (0.0, 1e12))
    for k in range(36):
        step = np.zeros(36)
        step[k] = 1e-6
        up, down = (
            cost_of(
                pack(moved(outlines, s * step, distance)),
                rays._replace(depth=rays.depth + s * 1e-6 * free.depth_per_pose[:, k]),
                distance,
                1.0,
            )
            for s in (1, -1)
        )
        assert free.vector[k] == pytest.approx(
            (up - down) / 2e-6, rel=0.02, abs=2e-3 * abs(held.vector).max()
        )
    # Going along the depths' own step lowers the cost, and what they take up makes the system softer.
    down = cost_of(pack(outlines), rays._replace(depth=rays.depth + 1e-3 * free.depth_step), distance, 1.0)
    assert down < free.cost
    taken = held.matrix - free.matrix
    assert np.linalg.eigvalsh(taken).min() > -1e-9 * np.abs(taken).max() and np.abs(taken).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize(("views", "least"), [(6, 2.5), (9, 5.0)])
def test_errors_shrink(views, least):
    for seed in range(2):
        noisy, true = scene(views, 1.0, seed, 200), scene(views, 0.0, seed, 200)
        found = refine_poses(noisy.train.cameras, noisy.train.masks)
        surface = np.asarray(true.mesh[0])[::60]
        before = pointing_error(noisy.train.cameras, true.train.cameras, surface).mean()
        after = pointing_error(found.cameras, true.train.cameras, surface).mean()
        assert after < before / least
        assert found.after < found.before


def test_masks_that_agree_change_nothing():
    train = scene(6, 0.0).train
    found = refine_poses(train.cameras, train.masks)
    assert torch.equal(found.cameras.world_from_camera, train.cameras.world_from_camera)
    assert not found.turned_deg.any()


def test_one_view_that_is_off_is_turned_back_by_as_much():
    true = scene(8, 0.0, size=200).train
    motion = true.cameras.world_from_camera.clone()
    turn = torch.as_tensor(rotations(np.radians([[0.6, -1.2, 0.5]]))[0])
    motion[3, :3, :3] = motion[3, :3, :3] @ turn
    cameras = Cameras(true.cameras.intrinsics, motion, true.cameras.width, true.cameras.height)
    found = refine_poses(cameras, true.masks, free=[3])
    assert found.turned_deg[3] == pytest.approx(np.linalg.norm([0.6, 1.2, 0.5]), rel=0.15)
    assert not np.delete(found.turned_deg, 3).any()
    left = true.cameras.world_from_camera[3, :3, :3].T @ found.cameras.world_from_camera[3, :3, :3]
    assert np.degrees(np.arccos(min((float(left.trace()) - 1) / 2, 1.0))) < 0.25


def test_the_frame_does_not_matter(noisy):
    """Moved by 100 lengths of the scene and 1000 times as large: the same turn of the one camera that is free."""
    train = noisy.train
    here = refine_poses(train.cameras, train.masks, free=[1])
    motion = train.cameras.world_from_camera.double().clone()
    motion[:, :3, 3] = 1000 * motion[:, :3, 3] + torch.tensor([1e5, -2e5, 3e5])
    cameras = Cameras(train.cameras.intrinsics, motion, train.cameras.width, train.cameras.height)
    there = refine_poses(cameras, train.masks, free=[1])
    assert here.turned_deg[1] > 0.1
    np.testing.assert_allclose(there.turned_deg, here.turned_deg, atol=0.01)


def test_the_number_of_threads_does_not_matter(noisy):
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(refine_poses(noisy.train.cameras, noisy.train.masks).cameras.world_from_camera)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_settings_out_of_range_are_refused(noisy):
    for config in (RefineConfig(turn_deg=0.0), RefineConfig(move=1.0), RefineConfig(turn_deg=float("nan"))):
        with pytest.raises(ConfigError, match="RefineConfig"):
            refine_poses(noisy.train.cameras, noisy.train.masks, config=config)


def test_few_views_are_refused_unless_one_camera_is_free():
    train = scene(4, 1.0).train
    with pytest.raises(SceneError, match="6 views or more"):
        refine_poses(train.cameras, train.masks)
    found = refine_poses(train.cameras, train.masks, free=[1])
    assert found.after <= found.before


def test_a_free_view_that_is_none_is_refused(noisy):
    with pytest.raises(ConfigError, match="free"):
        refine_poses(noisy.train.cameras, noisy.train.masks, free=[6])
