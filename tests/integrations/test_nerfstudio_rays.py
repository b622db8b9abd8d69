"""The sampler hook in nerfstudio's frame, and the pictures nerfstudio reads: without nerfstudio."""

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from visdom_plugin import Hull, VisDomSampler
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.integrations.nerfstudio.frame import Similarity, similarity_of
from visdom_plugin.integrations.nerfstudio.pictures import write_pictures
from visdom_plugin.integrations.nerfstudio.rays import bound_model_rays
from visdom_plugin.scene import Views

from .test_nerfstudio_frame import random_rotation


@pytest.fixture(scope="module")
def hull():
    n = 40
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return Hull.from_grid(x**2 + 2 * y**2 + z**2 < 0.6, ((299, -1, 4), (301, 1, 6)))


def rays_at(hull, count=400, seed=0):
    g = torch.Generator().manual_seed(seed)
    centre = torch.from_numpy(hull.centre)
    origins = centre + 4 * torch.nn.functional.normalize(
        torch.randn(count, 3, generator=g, dtype=torch.float64), dim=-1
    )
    targets = centre + 1.5 * (torch.rand(count, 3, generator=g, dtype=torch.float64) - 0.5)
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("missing", ["full", "skip"])
def test_bounds_do_not_depend_on_the_frame(hull, seed, missing):
    """In any model frame, a ray's interval is the world's interval times the scale."""
    g = torch.Generator().manual_seed(seed)
    shift = torch.randn(3, 1, generator=g, dtype=torch.float64) * 30
    frame = Similarity(torch.cat([random_rotation(g), shift], 1), float(10 ** torch.randn((), generator=g)))
    hook = VisDomSampler(hull, epsilon_world=0.1, missing=missing)
    origins, directions = rays_at(hull, seed=seed)
    near, far = torch.full((400,), 0.5).double(), torch.full((400,), 30.0).double()
    world = hook(origins, directions, near, far)
    model = bound_model_rays(
        hook,
        frame,
        frame.points_to_model(origins),
        directions @ frame.transform[:, :3].mT,
        near * frame.scale,
        far * frame.scale,
    )
    # A ray that grazes the hull may miss it after rounding.
    same = model.hit == world.hit
    assert same.double().mean() > 0.99 and 0.2 < world.hit.double().mean() < 0.98
    assert torch.allclose(model.near[same] / frame.scale, world.near[same], atol=1e-6)
    assert torch.allclose(model.far[same] / frame.scale, world.far[same], atol=1e-6)


def test_single_precision_stays_inside_the_models_bounds(hull):
    """A world far from its origin, and float32 rays: dtype, shape and [near, far] are kept."""
    origins, directions = rays_at(hull)
    frame = Similarity(
        torch.cat([torch.eye(3).double(), torch.tensor([[-300.0], [0], [-5]]).double()], 1), 0.25
    )
    hook = VisDomSampler(hull, epsilon_world=0.05, missing="skip")
    model = frame.points_to_model(origins).float().reshape(20, 20, 3), directions.float().reshape(20, 20, 3)
    near, far = torch.full((20, 20), 0.8), torch.full((20, 20), 1.02)
    bounds = bound_model_rays(hook, frame, *model, near, far)
    assert bounds.near.dtype == bounds.far.dtype == torch.float32 and bounds.near.shape == (20, 20)
    assert (near <= bounds.near).all() and (bounds.near <= bounds.far).all() and (bounds.far <= far).all()
    exact = hook(origins, directions, near.double().flatten() * 4, far.double().flatten() * 4)
    same = bounds.hit.flatten() == exact.hit
    assert same.double().mean() > 0.99
    assert (bounds.near.flatten().double() * 4 - exact.near)[same].abs().max() < 1e-5


def test_hull_of_a_scene_is_met_through_the_frame():
    """Rays through mask pixels of the training views meet the hull; frame and poses are as the data parser's."""
    views = load(None, views=4, downscale=4, test=False).train
    from visdom_plugin.hull.domain import VisibleDomain

    hull = VisibleDomain(resolution=64).carve(views.cameras, views.masks)
    frame, hook = similarity_of(views.cameras), VisDomSampler(hull)
    poses = frame.poses_to_model(views.cameras)
    for i, mask in enumerate(views.masks):
        world = rays_of(views.cameras[i])
        local = world.directions.reshape(-1, 3) @ views.cameras.world_from_camera[i, :3, :3]
        # OpenGL's camera axes.
        directions = (local * torch.tensor([1.0, -1.0, -1.0]).double()) @ poses[i, :, :3].mT
        origins = poses[i, :, 3].expand_as(directions)
        near = torch.full((len(directions),), 0.05).double()
        bounds = bound_model_rays(hook, frame, origins, directions, near, near * 1e4)
        seen = bounds.hit.reshape(mask.shape)
        assert (seen & mask).sum() > 0.85 * mask.sum()
        assert torch.equal(bounds.hit, hook(world.origins, world.directions, 0.01, 1e4).hit.flatten())


def a_view(seed, ignore=None):
    g = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (11, 17, 3), generator=g).to(torch.uint8)
    mask = torch.rand(11, 17, generator=g) < 0.4
    views = load(None, views=2, downscale=8, test=False).train
    return Views(views.cameras[:1], (image,), (mask,), (f"some/where {seed}.jpg",), (), ignore or ())


def test_pictures_hold_photograph_and_mask(tmp_path):
    views = a_view(1)
    (path,), counted = write_pictures(views, tmp_path)
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert counted is None and path.stem == "where_1"
    assert np.array_equal(read[..., 2::-1], views.images[0].numpy())
    assert np.array_equal(read[..., 3], views.masks[0].numpy() * np.uint8(255))


def test_pictures_are_written_once_and_never_mixed_up(tmp_path):
    (first,), _ = write_pictures(a_view(1), tmp_path)
    stamp = first.stat().st_mtime_ns
    (again,), _ = write_pictures(a_view(1), tmp_path)
    (other,), _ = write_pictures(a_view(2), tmp_path)
    assert again == first and again.stat().st_mtime_ns == stamp and other != first
    assert len(list(tmp_path.rglob("*.png"))) == 2 and not list(tmp_path.rglob(".*"))


def test_ignored_pixels_become_masks_of_what_counts(tmp_path):
    ignore = torch.zeros(11, 17, dtype=torch.bool)
    ignore[2:5, 3:9] = True
    _, (path,) = write_pictures(a_view(1, (ignore,)), tmp_path)
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(read == 0, ignore.numpy()) and set(np.unique(read)) == {0, 255}
