"""Views to repair stand between the training cameras; pictures are cut as cameras are."""

import math
from dataclasses import replace

import pytest
import torch

from visdom_plugin.geometry.camera_paths import orbit
from visdom_plugin.geometry.cameras import project
from visdom_plugin.methods.repair.configs import RepairConfig
from visdom_plugin.methods.repair.novel_views import NovelViews
from visdom_plugin.methods.repair.pictures import centre_camera, centre_square


@pytest.fixture(scope="module")
def ring(scene):
    """Six cameras on a circle, a sixth of it apart."""
    return orbit(scene.train.cameras, 6)


def draw(views, count=60):
    return [views.draw(torch.Generator().manual_seed(i)) for i in range(count)]


@pytest.mark.parametrize("away", [0.0, 0.8, 1.0])
def test_on_the_ellipse_they_stand_around_the_middles_between_neighbours(ring, away):
    views = NovelViews(ring, RepairConfig(away=away))
    radius = (views.centres - views.centres.mean(0)).norm(dim=-1).mean()
    seen = set()
    for camera in draw(views):
        apart = (views.centres - camera.centres.double()).norm(dim=-1).sort()
        # On a circle of this radius, a twelfth of it or up to a quarter of a sixth less.
        nearest = 2 * radius * math.sin((math.pi / 6) * (1 - away / 2) / 2)
        assert apart.values[0] >= nearest * 0.93
        assert (apart.indices[0] - apart.indices[1]).abs() in (1, 5)
        seen.add(tuple(sorted(apart.indices[:2].tolist())))
    assert len(seen) == 6


def test_between_two_they_keep_away_from_both(ring):
    views = NovelViews(ring, RepairConfig(novel_views="between", away=0.8))
    for camera in draw(views):
        local = (camera.camera_from_world @ torch.cat([views.look_at, torch.ones(1)]).to(camera.intrinsics))[
            :3
        ]
        assert torch.isfinite(local).all() and local[2] > 0
    assert min(views.weight(camera) for camera in draw(views)) > 0


def test_the_weight_grows_from_nothing_at_a_camera_to_one(ring):
    views = NovelViews(ring, RepairConfig())
    assert views.weight(ring[2]) == 0
    centres = ring.centres.double()
    third = torch.cdist(centres, centres).sort(-1).values[:, 2].max()
    assert views.reach == pytest.approx(1.2 * float(third))
    moved = ring[2].world_from_camera.clone()
    moved[:3, 3] += 0.1 * views.reach * moved[:3, 2]
    near = replace(ring[2], world_from_camera=moved)
    assert views.weight(near) == pytest.approx(0.2, abs=0.01)
    moved = moved.clone()
    moved[:3, 3] += 10 * views.reach * moved[:3, 0]
    assert views.weight(replace(near, world_from_camera=moved)) == 1


def test_two_cameras_are_enough(ring):
    views = NovelViews(ring[[0, 2]], RepairConfig())
    assert all(torch.isfinite(camera.centres).all() for camera in draw(views, 5)) and views.reach > 0


@pytest.mark.parametrize("size", [16, 33, 64, 65, 100])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (47, 65)])
def test_a_cut_picture_is_what_the_cut_camera_sees(scene, size, width, height):
    camera = scene.train.cameras[0].resized(width, height)
    cut = centre_camera(camera, size)
    assert cut.size == (size, size)
    points = scene.train.cameras.centres.mean(0) * 0.1 + torch.randn(
        50, 3, generator=torch.Generator().manual_seed(0)
    )
    (before, _), (after, _) = (project(c, points.to(camera.intrinsics)) for c in (camera, cut))
    shift = (after - before)[0].round()
    assert torch.allclose(after, before + shift, atol=1e-3)
    image = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))
    square = centre_square(image, size)
    dx, dy = (int(x) for x in shift)
    rows, columns = torch.meshgrid(torch.arange(size) - dy, torch.arange(size) - dx, indexing="ij")
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    assert torch.equal(square[inside], image[rows[inside], columns[inside]])
    assert bool((square[~inside] == 1).all())
