"""Laws of cameras."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import capture_up, interpolate, look_at_camera, orbit
from visdom_plugin.geometry.cameras import Cameras, look_at_point, project, rays_of
from visdom_plugin.geometry.rotations import matrix_from_quaternion


def ring(n: int = 5, target=(0.3, -0.2, 0.5), seed: int = 0) -> Cameras:
    g = torch.Generator().manual_seed(seed)
    target = torch.tensor(target, dtype=torch.float64)
    offsets = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1)
    motion = look_at_camera(target + 3 * offsets, target, target.new_tensor([0, 0, 1.0]))
    K = torch.tensor([[110.0, 0, 52.5], [0, 115.0, 37.0], [0, 0, 1]], dtype=torch.float64)
    return Cameras.from_matrices(K, motion, width=100, height=80)


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_rays_pass_through_what_projects_there(seed):
    cameras = ring(4, seed=seed)
    uv = torch.rand(4, 7, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 80
    rays = rays_of(cameras, uv)
    again, depth = project(cameras, rays.origins + 2.5 * rays.directions)
    assert torch.allclose(again, uv, atol=1e-9)
    assert (depth > 0).all()
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(4, 7, dtype=torch.float64))


def test_all_pixels_of_one_camera_start_at_half_a_pixel():
    camera = ring(1)[0]
    rays = rays_of(camera)
    assert rays.directions.shape == (80, 100, 3)
    uv, _ = project(camera, (rays.origins + rays.directions).reshape(-1, 3))
    assert torch.allclose(uv[0], torch.tensor([0.5, 0.5], dtype=torch.float64))
    assert torch.allclose(uv[-1], torch.tensor([99.5, 79.5], dtype=torch.float64))


def test_camera_maps_are_inverse():
    cameras = ring()
    product = cameras.camera_from_world @ cameras.world_from_camera
    assert torch.allclose(product, torch.eye(4, dtype=product.dtype).expand_as(product), atol=1e-12)


def test_opengl_poses_are_the_same_cameras():
    cameras = ring()
    flipped = cameras.world_from_camera * cameras.world_from_camera.new_tensor([1, -1, -1, 1])
    again = Cameras.from_matrices(cameras.intrinsics, flipped, width=100, height=80, convention="opengl")
    assert torch.equal(again.world_from_camera, cameras.world_from_camera)


def test_three_by_four_matrices_and_numpy_are_accepted():
    cameras = ring()
    again = Cameras.from_matrices(
        cameras.intrinsics.numpy(), cameras.world_from_camera.numpy()[:, :3], width=100, height=80
    )
    assert torch.equal(again.world_from_camera, cameras.world_from_camera)


def test_resizing_scales_projections():
    cameras, point = ring(), torch.zeros(5, 1, 3, dtype=torch.float64)
    small, _ = project(cameras.resized(50, 20), point)
    large, _ = project(cameras, point)
    assert torch.allclose(small, large * large.new_tensor([0.5, 0.25]))


@given(st.integers(0, 2**31), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_interpolation_keeps_the_ends_and_the_look_at_point(seed, t):
    cameras = ring(2, seed=seed)
    target = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    for end in (0, 1):
        camera = interpolate(cameras[0], cameras[1], float(end), target)
        assert torch.allclose(camera.world_from_camera, cameras[end].world_from_camera, atol=1e-8)
    between = interpolate(cameras[0], cameras[1], t, target)
    uv, depth = project(between, target[None])
    assert torch.allclose(uv[0], uv.new_tensor([52.5, 37.0]), atol=1e-6)
    assert math.isclose(float(depth), 3.0, abs_tol=1e-6)


def test_interpolation_is_equivariant_to_rigid_motion():
    cameras, t = ring(2), 0.3
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = matrix_from_quaternion(torch.tensor([0.3, -0.5, 0.2, 0.9], dtype=torch.float64))
    motion[:3, 3] = torch.tensor([4.0, -2.0, 1.0])
    target = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    moved = Cameras(cameras.intrinsics, motion @ cameras.world_from_camera, cameras.width, cameras.height)
    expected = motion @ interpolate(cameras[0], cameras[1], t, target).world_from_camera
    got = interpolate(moved[0], moved[1], t, motion[:3, :3] @ target + motion[:3, 3]).world_from_camera
    assert torch.allclose(got, expected, atol=1e-9)


def test_look_at_point_is_where_the_axes_meet():
    cameras = ring(6)
    # The principal axes meet at the target the ring was aimed at.
    assert torch.allclose(look_at_point(cameras), torch.tensor([0.3, -0.2, 0.5]).double(), atol=1e-4)


def test_orbit_looks_at_the_object_from_one_distance():
    circle = orbit(ring(6), 12)
    target = look_at_point(ring(6))
    _, depth = project(circle, target[None])
    assert torch.allclose(depth, torch.full_like(depth, 3.0), atol=1e-3)
    assert len(circle) == 12


def handheld(roll_degrees: float, seed: int) -> Cameras:
    """Four cameras on one side of an object, looking down at it, each rolled by about so much."""
    g = torch.Generator().manual_seed(seed)
    azimuth = torch.linspace(0, 1.2, 4).double() + 0.2 * torch.rand(4, generator=g).double()
    elevation = 0.4 + 0.6 * torch.rand(4, generator=g).double()
    flat = torch.stack([azimuth.cos(), azimuth.sin()], -1) * elevation.cos()[:, None]
    centres = 3 * torch.cat([flat, elevation.sin()[:, None]], -1)
    motion = look_at_camera(centres, torch.zeros(3).double(), torch.tensor([0, 0, 1.0]).double())
    roll = math.radians(roll_degrees) * torch.randn(4, generator=g).double()
    turn = torch.eye(4).double().repeat(4, 1, 1)
    turn[:, 0, 0] = turn[:, 1, 1] = roll.cos()
    turn[:, 1, 0], turn[:, 0, 1] = roll.sin(), -roll.sin()
    K = torch.tensor([[110.0, 0, 50], [0, 110.0, 40], [0, 0, 1]], dtype=torch.float64)
    return Cameras.from_matrices(K, motion @ turn, width=100, height=80)


def tilt_degrees(up, true=(0.0, 0.0, 1.0)) -> float:
    return math.degrees(math.acos(min(1.0, float(up @ torch.as_tensor(true, dtype=up.dtype)))))


@pytest.mark.parametrize("seed", range(5))
def test_up_is_where_level_cameras_say_whatever_side_they_stand_on(seed):
    cameras = handheld(0.0, seed)
    mean = -cameras.world_from_camera[:, :3, 1].mean(0)
    assert tilt_degrees(mean / mean.norm()) > 20
    assert tilt_degrees(capture_up(cameras)) < 0.2 * tilt_degrees(mean / mean.norm())
    # Up turns with the world.
    turn = matrix_from_quaternion(torch.tensor([0.3, -0.5, 0.7, 0.2]).double())
    poses = cameras.world_from_camera.clone()
    poses[:, :3] = turn @ poses[:, :3]
    turned = Cameras(cameras.intrinsics, poses, cameras.width, cameras.height)
    assert torch.allclose(capture_up(turned), turn @ capture_up(cameras), atol=1e-12)


def test_cameras_that_are_held_by_hand_give_a_better_up_than_their_mean():
    tilts, means = [], []
    for seed in range(40):
        cameras = handheld(4.0, seed)
        mean = -cameras.world_from_camera[:, :3, 1].mean(0)
        tilts.append(tilt_degrees(capture_up(cameras)))
        means.append(tilt_degrees(mean / mean.norm()))
    assert np.median(tilts) < 0.4 * np.median(means)


def test_up_of_cameras_whose_ups_cancel_is_z():
    down = look_at_camera(
        torch.tensor([[0.0, 0, 3], [0, 0, 3]]), torch.zeros(3), torch.tensor([[1.0, 0, 0], [-1, 0, 0]])
    )
    cameras = Cameras.from_matrices(
        torch.tensor([[110.0, 0, 50], [0, 110, 40], [0, 0, 1]]), down, width=100, height=80
    )
    assert capture_up(cameras).tolist() == [0, 0, 1]


def skewed(K, row: int, column: int):
    K = K.copy()
    K[row, column] = K[0, 0]
    return K


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda K, T: (K * np.nan, T), "NaN"),
        (lambda K, T: (K, T * 2), "not a rotation"),
        (lambda K, T: (K, T * [1, 1, -1, 1]), "not a rotation"),
        (lambda K, T: (K * [[1], [-1], [1]], T), "positive focal"),
        (lambda K, T: (K[:2], T), "shapes"),
        (
            lambda K, T: (K, T.swapaxes(1, 2)),
            r"last row of world_from_camera of cameras 0, 1, 2.*\n.*transposed",
        ),
        (lambda K, T: (K.T, T), r"last row of the intrinsics.*52\.5"),
        (lambda K, T: (K * [[1], [1], [-1]], T), "last row of the intrinsics"),
        (lambda K, T: (skewed(K, 1, 0), T), "no skew"),
        (lambda K, T: (skewed(K, 0, 1), T), "no skew"),
        (lambda K, T: (np.stack([K, K]), T), r"shape \(2,\).*\(3,\)"),
    ],
)
def test_bad_matrices_are_named(change, words):
    cameras = ring(3)
    K, T = change(cameras.intrinsics[0].numpy(), cameras.world_from_camera.numpy())
    with pytest.raises(SceneError, match=words):
        Cameras.from_matrices(K, T, width=100, height=80)


def test_the_one_transposed_matrix_is_named():
    cameras = ring(3)
    motion = cameras.world_from_camera.clone()
    motion[1] = motion[1].mT.clone()
    with pytest.raises(SceneError, match=r"of camera 1 is \("):
        Cameras.from_matrices(cameras.intrinsics, motion, width=100, height=80)


@given(st.integers(0, 2), st.integers(0, 2), st.floats(1e-3, 1e3), st.booleans())
@settings(max_examples=60, deadline=None)
def test_accepted_intrinsics_leave_project_and_rays_of_each_others_inverse(row, column, change, minus):
    # Whatever entry of K is changed: either it is refused, or rays still project to where they came from.
    cameras = ring(2)
    K = cameras.intrinsics.clone()
    K[:, row, column] += -change if minus else change
    try:
        cameras = Cameras.from_matrices(K, cameras.world_from_camera, width=100, height=80)
    except SceneError:
        return
    uv = torch.rand(2, 5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 80
    rays = rays_of(cameras, uv)
    again, _ = project(cameras, rays.origins + 2.5 * rays.directions)
    assert torch.allclose(again, uv, atol=1e-3)


def test_sizes_that_do_not_match_the_cameras_are_named():
    cameras = ring(4)
    with pytest.raises(SceneError, match=r"width has shape \(2,\) for cameras of shape \(4,\)"):
        Cameras.from_matrices(cameras.intrinsics, cameras.world_from_camera, width=[48, 48], height=[48] * 4)
    with pytest.raises(SceneError, match="height has shape"):
        cameras.resized(48, [48] * 3)


def test_only_one_batch_of_cameras_will_do():
    from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer
    from visdom_plugin.hull.domain import VisibleDomain
    from visdom_plugin.hull.hull import Hull

    cameras = ring(3)
    singles = [cameras[i] for i in range(3)]
    masks = [torch.ones(80, 100, dtype=torch.bool)] * 3
    hull = Hull.from_grid(np.ones((2, 2, 2)), [[-1] * 3, [1] * 3])
    for wrong, words in ((singles, r"Cameras\.stack"), (cameras[0], "cameras\\[None\\]"), (None, "NoneType")):
        with pytest.raises(SceneError, match=words):
            VisibleDomain(resolution=8).carve(wrong, masks)
        with pytest.raises(SceneError, match=words):
            VisDomGaussianRegularizer(hull, wrong)
    assert len(VisDomGaussianRegularizer(hull, Cameras.stack(singles)).cameras) == 3


def test_unknown_convention_lists_the_known_ones():
    with pytest.raises(SceneError, match="opengl"):
        Cameras.from_matrices(np.eye(3), np.eye(4), width=10, height=10, convention="blender")


K = np.array([[110.0, 0, 52.5], [0, 115.0, 37.0], [0, 0, 1]])


@pytest.mark.parametrize(
    "wrong, words",
    [
        (np.diag([1 / 100, 1 / 80, 1]) @ K, "fractions(.|\n)*first row by the width"),
        (
            np.array([[110, 0, 0.525], [0, 115, 0.46], [0, 0, 1]]),
            "fractions(.|\n)*cx by the width",
        ),
        (np.diag([110, 115, 1]), "left at 0(.|\n)*cx about width"),
        (np.array([[60, 0, 0.5], [0, 60, 0.5], [0, 0, 1]]), "fractions(.|\n)*60 is an angle in degrees"),
        (np.array([[0.85, 0, 50], [0, 0.68, 40], [0, 0, 1]]), "an angle"),
    ],
)
def test_intrinsics_in_another_unit_are_refused(wrong, words):
    for batch in (wrong, np.stack([K, wrong])):
        with pytest.raises(SceneError, match=f"not in pixels(.|\n)*{words}"):
            Cameras.from_matrices(batch, np.eye(4), width=100, height=80)


def test_angles_in_degrees_are_refused_where_no_lens_is_so_wide():
    wrong = np.array([[49.0, 0, 600], [0, 38.0, 400], [0, 0, 1]])
    with pytest.raises(SceneError, match=r"an angle(.|\n)*tan"):
        Cameras.from_matrices(wrong, np.eye(4), width=1200, height=800)


def test_off_centre_crops_and_tiny_images_are_cameras():
    crop = np.array([[110, 0, -7.0], [0, 115, 90.0], [0, 0, 1]])
    assert Cameras.from_matrices(crop, np.eye(4), width=100, height=80).shape == ()
    assert Cameras.from_matrices(np.eye(3) + 0, np.eye(4), width=1, height=1).shape == ()
