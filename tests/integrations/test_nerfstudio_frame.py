"""Nerfstudio's frame and back: laws of the similarity, without nerfstudio."""

import re
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import visdom_plugin
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, look_at_point, rays_of
from visdom_plugin.integrations.nerfstudio.frame import Similarity, similarity_of


def random_rotation(g):
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r))
    return q * torch.sign(torch.linalg.det(q))


def random_similarity(seed):
    g = torch.Generator().manual_seed(seed)
    shift = torch.randn(3, 1, generator=g, dtype=torch.float64) * 50
    scale = float(10 ** (torch.rand((), generator=g) * 6 - 3))
    return Similarity(torch.cat([random_rotation(g), shift], 1), scale)


def random_cameras(seed, count=5):
    g = torch.Generator().manual_seed(seed)
    K = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = 90.0, 95.0, 30.5, 21.0
    centres = torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=-1)
    target = torch.randn(3, generator=g, dtype=torch.float64) * 20
    up = torch.tensor([0.2, 0.1, 1.0], dtype=torch.float64)
    distance = 3 + 0.3 * torch.rand(count, 1, generator=g, dtype=torch.float64)
    motion = look_at_camera(target + distance * centres, target.expand(count, 3), up)
    return Cameras.from_matrices(K, motion, width=60, height=40)


def seeds(test):
    return settings(max_examples=30, deadline=None)(given(seed=st.integers(0, 10_000))(test))


@seeds
def test_points_come_back(seed):
    frame = random_similarity(seed)
    world = torch.randn(40, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 100
    back = frame.points_to_world(frame.points_to_model(world))
    assert torch.allclose(back, world, rtol=1e-9, atol=1e-9)


@seeds
def test_it_is_nerfstudios_convention(seed):
    """Nerfstudio puts homogeneous points through the 3 x 4 transform, then multiplies by the scale."""
    frame = random_similarity(seed)
    world = torch.randn(7, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    by_hand = torch.stack(
        [frame.transform @ torch.cat([p, torch.ones(1, dtype=torch.float64)]) * frame.scale for p in world]
    )
    assert torch.allclose(frame.points_to_model(world), by_hand)


@seeds
def test_points_on_rays_are_the_same_points(seed):
    """t_world = t_model / scale, for directions of any length."""
    frame, g = random_similarity(seed), torch.Generator().manual_seed(seed)
    origins = torch.randn(20, 3, generator=g, dtype=torch.float64)
    directions = torch.randn(20, 3, generator=g, dtype=torch.float64)
    t = torch.rand(20, 1, generator=g, dtype=torch.float64) * 5
    along = frame.points_to_world(origins) + t / frame.scale * frame.directions_to_world(directions)
    there = frame.points_to_world(origins + t * directions)
    assert torch.allclose(along, there, rtol=1e-9, atol=1e-9)
    turned = frame.directions_to_world(directions)
    assert torch.allclose(turned.norm(dim=-1), directions.norm(dim=-1))
    assert torch.allclose(frame.directions_to_model(turned), directions, atol=1e-12)


@seeds
def test_cameras_come_back_and_see_the_same(seed):
    frame, cameras = random_similarity(seed), random_cameras(seed)
    poses = frame.poses_to_model(cameras)
    axes = frame.transform[:, :3].mT @ (poses[..., :3] * poses.new_tensor([1.0, -1.0, -1.0]))
    back = torch.cat([axes, frame.points_to_world(poses[..., 3])[..., None]], -1)
    assert torch.allclose(back, cameras.world_from_camera[:, :3], atol=1e-8)
    # OpenGL's camera looks along -z, with y up.
    pixel = torch.tensor([[40.0, 10.0]], dtype=torch.float64).expand(len(cameras), 1, 2)
    rays = rays_of(cameras, pixel)
    local = torch.tensor([(40.0 - 30.5) / 90, -(10.0 - 21) / 95, -1.0], dtype=torch.float64)
    turned = torch.nn.functional.normalize(poses[:, :, :3] @ local, dim=-1)
    assert torch.allclose(frame.directions_to_world(turned), rays.directions[:, 0], atol=1e-9)
    assert torch.allclose(frame.points_to_world(poses[:, :, 3]), rays.origins[:, 0], atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_keep_their_dtype_into_the_model(dtype):
    assert random_similarity(3).points_to_model(torch.zeros(2, 3, dtype=dtype)).dtype == dtype


@seeds
def test_frame_of_a_capture(seed):
    cameras = random_cameras(seed)
    frame = similarity_of(cameras)
    rotation = frame.transform[:, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert torch.linalg.det(rotation) > 0
    poses = frame.poses_to_model(cameras)
    assert torch.allclose(poses[:, :, 3].norm(dim=-1).mean(), torch.ones((), dtype=torch.float64))
    assert frame.points_to_model(look_at_point(cameras)).abs().max() < 1e-9
    up = poses[:, :, 1].mean(0)
    assert up[:2].abs().max() < 1e-9 or up.norm() < 0.3


def test_frame_moves_with_the_capture():
    """Another world frame of the same capture gives the same model frame, up to a turn about z."""
    cameras, other = random_cameras(1), random_similarity(2)
    motion = cameras.world_from_camera.clone()
    motion[:, :3, :3] = other.transform[:, :3] @ motion[:, :3, :3]
    motion[:, :3, 3] = other.points_to_model(motion[:, :3, 3])
    moved = Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)
    one, two = similarity_of(cameras).poses_to_model(cameras), similarity_of(moved).poses_to_model(moved)
    assert torch.allclose(one[:, 2], two[:, 2], atol=1e-6)
    gram = [p[:, :, 3] @ p[:, :, 3].mT for p in (one, two)]
    assert torch.allclose(*gram, atol=1e-6)


def test_nerfstudio_is_imported_in_its_room_alone():
    root = Path(visdom_plugin.__file__).parents[1]
    sources = [
        p for name in ("visdom_plugin", "datamodules", "method_configs") for p in (root / name).rglob("*.py")
    ]
    room = root / "visdom_plugin/integrations/nerfstudio"
    imports = re.compile(r"^\s*(import|from) (nerfstudio|visdom_plugin\.integrations\.nerfstudio)\b", re.M)
    assert [p for p in sources if room not in p.parents and imports.search(p.read_text("utf-8"))] == []
    assert any(imports.search(p.read_text("utf-8")) for p in room.glob("*.py"))
