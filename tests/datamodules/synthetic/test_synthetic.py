"""The built-in scene: a closed mesh, masks that are its silhouettes, noise that stays where it belongs."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh

from datamodules import load
from datamodules.built_in import DEFAULT
from datamodules.synthetic.catalogue import find_object
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.noise import disturb_poses
from datamodules.synthetic.render import rasterise
from datamodules.synthetic.scene import make_scene, to_world
from datamodules.synthetic.shape import watering_can
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import project, rays_of


def crossings(origins, directions, vertices, faces):
    """The slow twin: every ray against every triangle (Moller and Trumbore 1997).

    Returns t (R, F), NaN where the ray misses the face, and whether it goes in (R, F).
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(directions[:, None], e2)
    det = (p * e1).sum(-1)
    s = origins[:, None] - a
    u = (s * p).sum(-1) / det
    q = np.cross(s, e1)
    v = (directions[:, None] * q).sum(-1) / det
    t = (q * e2).sum(-1) / det
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.nan), det > 0


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=(40, 32), train_views=9, test_views=2))


@pytest.fixture(scope="module")
def mesh(scene):
    return scene.mesh[0].numpy(), scene.mesh[1].numpy()


def test_mesh_is_closed_outward_with_two_holes(mesh):
    solid = trimesh.Trimesh(*mesh, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert solid.euler_number == 2 - 2 * 2
    assert len(np.unique(mesh[1])) == len(mesh[0])
    assert solid.area_faces.min() > 0
    # Hard on purpose: far from the origin, not of unit size.
    assert np.linalg.norm(solid.bounds.mean(0)) > 1.5
    assert solid.extents.max() > 2


def test_mesh_does_not_run_through_itself(mesh):
    """Along any line a simple solid is entered and left in turn."""
    draw = np.random.default_rng(3)
    low, high = mesh[0].min(0), mesh[0].max(0)
    origins = draw.uniform(low, high, (400, 3))
    directions = draw.normal(size=(400, 3))
    origins -= 10 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    several = 0
    for at in range(0, 400, 50):
        t, enters = crossings(origins[at : at + 50], directions[at : at + 50], *mesh)
        for ray in range(len(t)):
            order = np.argsort(t[ray])[: np.isfinite(t[ray]).sum()]
            turns = enters[ray][order]
            assert (turns == (np.arange(len(turns)) % 2 == 0)).all()
            several += len(turns) >= 4
    assert several > 20


def test_masks_are_the_silhouettes_of_the_mesh(scene, mesh):
    views = [(scene.train, 0), (scene.train, 4), (scene.test, 1)]
    for views_of, i in views:
        rays = rays_of(views_of.cameras[i])
        origins, directions = (x.reshape(-1, 3).numpy() for x in rays)
        hit = [
            np.isfinite(crossings(o, d, *mesh)[0]).any(1)
            for o, d in zip(np.array_split(origins, 26), np.array_split(directions, 26), strict=True)
        ]
        assert np.array_equal(np.concatenate(hit).reshape(32, 40), views_of.masks[i].numpy())


def test_the_nearest_surface_is_drawn(scene, mesh):
    camera = scene.train.cameras[3]
    uv, depth = project(camera, scene.mesh[0])
    seen = rasterise(uv.numpy(), depth.numpy(), mesh[1], 40, 32)
    assert np.array_equal(seen.sample, np.flatnonzero(scene.train.masks[3].numpy().ravel()))
    assert np.allclose(seen.weights.sum(1), 1)
    points = (mesh[0][mesh[1][seen.face]] * seen.weights[..., None]).sum(1)
    origins, directions = (x.reshape(-1, 3)[seen.sample].numpy() for x in rays_of(camera))
    for part in np.array_split(np.arange(len(points)), 12):
        t = np.nanmin(crossings(origins[part], directions[part], *mesh)[0], axis=1)
        assert np.allclose(points[part], origins[part] + t[:, None] * directions[part], atol=1e-9)


def test_what_is_drawn_lies_inside_the_image_whatever_the_crop():
    vertices, faces = to_world(watering_can().vertices, find_object(DEFAULT).middle), watering_can().faces
    scene = make_scene(SyntheticConfig(size=(24, 20), train_views=2, test_views=0, truncation=0.9))
    uv, depth = project(scene.train.cameras[1], torch.from_numpy(vertices))
    assert ((uv < 0) | (uv > 24)).any()
    seen = rasterise(uv.numpy(), depth.numpy(), faces, 24, 20)
    assert seen.sample.min() >= 0
    assert seen.sample.max() < 24 * 20
    assert (np.diff(seen.sample) > 0).all()


def test_photographs_agree_between_views(scene, mesh):
    """A surface point shows the same colour from every side: the textures sit on the object."""
    big = make_scene(SyntheticConfig(size=160, train_views=2, test_views=2))
    points = torch.from_numpy(mesh[0][mesh[1]].mean(1))
    colours, counts = [], []
    for i in range(2):
        camera = big.test.cameras[i]
        uv, depth = project(camera, scene.mesh[0])
        seen = rasterise(uv.numpy(), depth.numpy(), mesh[1], 160, 160)
        visible = np.isin(np.arange(len(points)), seen.face)
        pixel, _ = project(camera, points)
        column, row = pixel.long().clamp(0, 159).unbind(-1)
        colours.append(big.test.images[i][row, column].float() / 255)
        counts.append(visible)
    both = torch.from_numpy(counts[0] & counts[1])
    assert both.sum() > 150
    same = (colours[0] - colours[1])[both].abs().mean()
    mixed = (colours[0][both] - colours[1][both].roll(37, 0)).abs().mean()
    assert same < 0.4 * mixed


def test_equal_configs_give_equal_bits_in_any_process(scene):
    again = make_scene(SyntheticConfig(size=(40, 32), train_views=9, test_views=2))
    assert again.source == scene.source
    assert all(map(torch.equal, again.test.images, scene.test.images))
    code = (
        "from datamodules.synthetic.scene import *; "
        "print(make_scene(SyntheticConfig(size=(40, 32), train_views=9, test_views=2)).source['hashes'])"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    out = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == str(scene.source["hashes"])


@pytest.mark.parametrize("views", [2, 3, 4, 6, 16])
def test_fewer_views_are_the_first_of_more(scene, views):
    fewer = make_scene(SyntheticConfig(size=(40, 32), train_views=views, test_views=2))
    shared = min(views, 9)
    assert len(fewer.train) == views
    assert fewer.train.names[:shared] == scene.train.names[:shared]
    assert all(map(torch.equal, fewer.train.images[:shared], scene.train.images[:shared]))
    assert all(map(torch.equal, fewer.test.images, scene.test.images))


def test_views_are_spread_and_their_frusta_differ():
    scene = make_scene(SyntheticConfig(size=32, train_views=16, test_views=16))
    away = torch.nn.functional.normalize(scene.train.cameras.centres - scene.mesh[0].mean(0), dim=-1)
    angles = torch.rad2deg(torch.acos((away @ away.mT).clamp(-1, 1))) + 360 * torch.eye(16)
    assert angles[:4, :4].min() > 55
    assert angles[:9, :9].min() > 25
    K = scene.train.cameras.intrinsics[:4]
    assert len(K[:, 0, 0].unique()) >= 3
    assert ((K[:, :2, 2] - 16).abs().amax(-1) > 0.3).all()
    uv, _ = project(scene.test.cameras, scene.mesh[0])
    assert ((uv > 0) & (uv < 32)).all()


def test_the_number_of_votes_asked_for_changes_the_hull():
    scene = make_scene(SyntheticConfig(test_views=0))
    cameras, low, high = scene.train.cameras, scene.mesh[0].amin(0) - 1, scene.mesh[0].amax(0) + 1
    axes = [
        torch.linspace(float(a), float(b), 72, dtype=torch.float64) for a, b in zip(low, high, strict=True)
    ]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def votes(points):
        uv, depth = project(cameras, points)
        seen = (depth > 0) & (uv >= 0).all(-1) & (uv < 200).all(-1)
        column, row = uv.clamp(0, 199).long().unbind(-1)
        masks = torch.stack(list(scene.train.masks))
        inside = seen & masks[torch.arange(4)[:, None], row, column]
        return seen.sum(0), inside.sum(0)

    seen, inside = votes(grid)
    volume = [float(((seen >= k) & (inside == seen)).sum()) for k in range(1, 5)]
    assert all(less < 0.975 * more for more, less in pairwise(volume))
    # K = 4 cuts into the object, K = 3 does not.
    seen, _ = votes(scene.mesh[0])
    assert seen.min() == 3
    assert (seen == 3).float().mean() > 0.03


def test_downscale_is_a_smaller_photograph_of_the_same_cameras():
    full = make_scene(SyntheticConfig(size=96, test_views=1))
    half = load(None, views=4, downscale=200 / 48)
    assert half.train.images[0].shape == (48, 48, 3)
    assert torch.allclose(half.train.cameras.intrinsics[:, :2], full.train.cameras.intrinsics[:, :2] / 2)
    for small, big in zip(half.train.images, full.train.images, strict=True):
        averaged = big.float().reshape(48, 2, 48, 2, 3).mean((1, 3))
        assert (small.float() - averaged).abs().mean() < 5


@pytest.mark.parametrize(
    "knob",
    [
        {"rotation_noise_deg": 2.0},
        {"translation_noise": 0.02},
        {"erode_px": 1},
        {"dilate_px": 2},
        {"flip_fraction": 0.05},
        {"truncation": 0.3},
    ],
)
def test_noise_changes_training_views_only(scene, knob):
    config = SyntheticConfig(size=(40, 32), train_views=9, test_views=2)
    noisy = make_scene(replace(config, **knob))
    assert noisy.source["hashes"] != scene.source["hashes"]
    assert torch.equal(noisy.test.cameras.world_from_camera, scene.test.cameras.world_from_camera)
    assert torch.equal(noisy.test.cameras.intrinsics, scene.test.cameras.intrinsics)
    assert all(map(torch.equal, noisy.test.images, scene.test.images))
    assert all(map(torch.equal, noisy.test.masks, scene.test.masks))
    other = make_scene(replace(config, **knob, seed=1))
    same = other.source["hashes"] == noisy.source["hashes"]
    assert same == (not {"rotation_noise_deg", "translation_noise", "flip_fraction"} & set(knob))


def test_pose_noise_has_the_spread_asked_for():
    scene = make_scene(SyntheticConfig(size=16, train_views=16, test_views=0))
    cameras = scene.train.cameras
    angles, moves = [], []
    for seed in range(40):
        off = disturb_poses(
            cameras, SyntheticConfig(rotation_noise_deg=3, translation_noise=0.05, train_views=16, seed=seed)
        )
        turn = cameras.world_from_camera[:, :3, :3].mT @ off.world_from_camera[:, :3, :3]
        angles.append(torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
        distance = (cameras.centres - scene.mesh[0].mean(0)).norm(dim=-1)
        moves.append((off.centres - cameras.centres).norm(dim=-1) / distance)
    spread = torch.rad2deg(torch.cat(angles)).square().mean().sqrt()
    assert abs(spread / 3 - 1) < 0.1
    assert abs(torch.cat(moves).square().mean().sqrt() / 0.05 - 1) < 0.1


def test_mask_noise_is_what_it_says():
    clean = make_scene(SyntheticConfig(size=64, test_views=0)).train.masks
    for knob, radius in (("erode_px", 2), ("dilate_px", 3)):
        noisy = make_scene(SyntheticConfig(size=64, test_views=0, **{knob: radius})).train.masks
        for before, after in zip(clean, noisy, strict=True):
            grown = before if knob == "dilate_px" else ~before
            rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
            pixels = torch.stack([rows, columns], -1).reshape(-1, 2).float()
            near = torch.cdist(pixels, pixels[grown.reshape(-1)]).amin(1).reshape(64, 64) <= radius
            assert torch.equal(after, near if knob == "dilate_px" else ~near)
    flipped = make_scene(SyntheticConfig(size=64, test_views=0, flip_fraction=0.1)).train.masks
    share = torch.stack([a ^ b for a, b in zip(clean, flipped, strict=True)]).float().mean()
    assert abs(share - 0.1) < 0.01


def test_truncation_pushes_the_object_out_of_every_other_view():
    scene = make_scene(SyntheticConfig(size=64, train_views=6, test_views=0, truncation=0.4))
    uv, _ = project(scene.train.cameras, scene.mesh[0])
    left, right = uv[..., 0].amin(1), uv[..., 0].amax(1)
    lost = 1 - (right.clamp(max=64) - left.clamp(min=0)) / (right - left)
    assert torch.allclose(lost[1::2], torch.full((3,), 0.4, dtype=lost.dtype), atol=1e-9)
    exact = make_scene(SyntheticConfig(size=64, train_views=6, test_views=0))
    assert all(map(torch.equal, scene.train.images[::2], exact.train.images[::2]))


@pytest.mark.parametrize("background", ["white", "black"])
def test_plain_backgrounds(background):
    scene = make_scene(SyntheticConfig(size=160, test_views=1, background=background))
    image, mask = scene.test.images[0], scene.test.masks[0]
    near = torch.nn.functional.max_pool2d(mask[None, None].float(), 5, 1, 2)[0, 0] > 0
    assert (image[~near] == (255 if background == "white" else 0)).all()
    room = make_scene(SyntheticConfig(size=160, test_views=1)).test.images[0]
    inner = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, 1, 1)[0, 0] == 0
    assert torch.equal(room[inner], image[inner])
    assert room[~near].float().std() > 10


@pytest.mark.parametrize(
    "knob",
    [
        {"train_views": 1},
        {"train_views": 17},
        {"size": 4},
        {"size": (200, 100000)},
        {"downscale": 0.5},
        {"downscale": 100},
        {"truncation": 1.0},
        {"flip_fraction": -0.1},
        {"background": "beach"},
        {"erode_px": -1},
        {"rotation_noise_deg": float("nan")},
    ],
)
def test_knobs_out_of_range_are_named(knob):
    with pytest.raises(ConfigError, match="built-in scene"):
        make_scene(SyntheticConfig(**knob))
