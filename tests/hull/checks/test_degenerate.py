"""Degenerate geometry is refused, or said to be what it is; sound captures of any size are not."""

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, ring
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.degenerate import count_cameras_inside, describe_speck, stand_at_one_point
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull

SMALL = VisibleDomain(resolution=48)
OBJECT = [((0, 0, 0), 0.5), ((0.45, 0.1, 0.3), 0.3), ((-0.3, -0.2, -0.3), 0.25)]


def turntable(count, heights=(0.8,)):
    """Cameras at equal steps round the origin, all of which they look at, and their masks."""
    angle = 0.2 + np.arange(count) * 2 * np.pi / count
    up = np.resize(heights, count)
    centres = torch.from_numpy(np.stack([3 * np.cos(angle), 3 * np.sin(angle), up], -1))
    motion = look_at_camera(centres, torch.zeros(count, 3).double(), torch.tensor([0.0, 0, 1]).double())
    K = torch.tensor([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]]).double().expand(count, 3, 3)
    cameras = Cameras.from_matrices(K, motion, width=64, height=64)
    return cameras, ball_masks(cameras, OBJECT)


def inverted(cameras, noise=0.0):
    motion = torch.linalg.inv(cameras.world_from_camera)
    draw = torch.Generator().manual_seed(0)
    motion[:, :3, 3] += noise * torch.randn(len(motion), 3, generator=draw, dtype=torch.float64)
    return Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)


@pytest.mark.parametrize("noise", [0.0, 1e-13, 1e-10, 1e-7, 3e-6])
@pytest.mark.parametrize("count", [4, 8])
def test_world_to_camera_poses_of_a_turntable_are_refused(count, noise):
    """Their inverses put all cameras at one point, give or take what arithmetic and files round."""
    cameras, masks = turntable(count)
    assert SMALL.carve(cameras, masks).voxels
    with pytest.raises(SceneError) as caught:
        SMALL.carve(inverted(cameras, noise), masks)
    assert "world-to-camera matrices:" in caught.value.cause and caught.value.where == "camera poses"
    assert "more views" not in str(caught.value) and "larger k" not in str(caught.value)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_world_to_camera_poses_of_two_rings_are_refused(count):
    """Views that meet by chance can leave a hull that covers three quarters of the masks."""
    cameras, masks = turntable(count, (0.5, 1.2))
    with pytest.raises(SceneError, match="world-to-camera matrices:"):
        SMALL.carve(inverted(cameras), masks)


def test_cameras_that_turn_on_the_spot_are_refused_and_found():
    cameras, _ = turntable(5)
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] = torch.tensor([1.0, 2.0, 3.0]).double()
    still = Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)
    rows, columns = np.mgrid[:64, :64]
    masks = [np.hypot(rows - 20 - 5 * i, columns - 30) < 9 for i in range(5)]
    with pytest.raises(SceneError, match="all 5 cameras stand at one point") as caught:
        SMALL.carve(still, masks)
    assert "invert" in caught.value.todo
    (found,) = (f for f in check(still, masks).findings if f.kind != "duplicate")
    assert (found.kind, found.sure) == ("centres", "certain")
    assert not stand_at_one_point(still[:1]) and not stand_at_one_point(cameras)


@pytest.mark.parametrize("scale", [1e-7, 1e-3, 1e3, 1e7])
def test_the_unit_of_a_sound_capture_changes_nothing(scale):
    cameras = ring(6)
    masks = ball_masks(cameras, OBJECT)
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] *= scale
    one, other = (
        SMALL.carve(c, masks)
        for c in (cameras, Cameras(cameras.intrinsics, motion, cameras.width, cameras.height))
    )
    np.testing.assert_allclose(other.bounds / scale, one.bounds, rtol=1e-6, atol=1e-6)
    assert abs(other.voxels - one.voxels) < 1e-3 * one.voxels


def test_a_survey_is_no_point():
    cameras = ring(6)
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] += torch.tensor([4.5e5, 5.2e6, 120.0]).double()
    far = Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)
    assert not stand_at_one_point(far)
    assert SMALL.carve(far, ball_masks(cameras, OBJECT)).voxels


def test_a_hull_smaller_than_a_pixel_is_a_speck():
    cameras = ring(5, distance=4.0, size=100, focal=2.0)
    footprint = 4.0 / 200
    for size, small in ((0.5 * footprint, True), (3 * footprint, False)):
        hull = Hull.from_grid(np.ones((3, 3, 3)), [[-size / 2] * 3, [size / 2] * 3])
        assert (describe_speck(cameras, hull) is not None) == small


def test_cameras_inside_the_hull_are_counted_where_several_views_must_agree():
    cameras = ring(6, distance=2.0)
    domain = VisibleDomain(k=2)
    hull = Hull.from_grid(np.ones((2, 2, 2)), [[-3.0] * 3, [0.0, 3.0, 3.0]])
    inside = int((cameras.centres[:, 0] < 0).sum())
    assert 0 < inside < 6 and count_cameras_inside(KeepRule.of(domain, 6), cameras, hull) == inside
    for alone in (VisibleDomain(k=1), VisibleDomain(kind="traditional")):
        assert count_cameras_inside(KeepRule.of(alone, 6), cameras, hull) == 0
