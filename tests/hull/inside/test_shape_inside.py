"""Laws of the shape inside the hull."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules import load
from tests.hull.balls import ball_masks, moved, ring
from visdom_plugin.errors import ConfigError, EmptyHullError
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.grid.mesh import is_closed
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.hull.inside.shape import shape_inside

BALLS = [((0.0, 0.0, 0.0), 0.8), ((0.7, 0.3, 0.5), 0.4), ((-0.2, 0.9, -0.6), 0.25)]


def carve(cameras, masks, ignore=(), *, resolution=64, **fields) -> Hull:
    return VisibleDomain(resolution=resolution, **fields).carve(cameras, masks, ignore)


@pytest.fixture(scope="module")
def capture():
    cameras = ring(4)
    masks = ball_masks(cameras, BALLS)
    return cameras, masks, carve(cameras, masks)


@pytest.fixture(scope="module")
def built_in():
    scene = load(None, views=4, downscale=2)
    hull = carve(*scene.train.silhouettes(), resolution=128)
    return scene, hull, shape_inside(hull, *scene.train.silhouettes())


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def test_nested_in_the_hull_and_smaller(capture):
    cameras, masks, hull = capture
    inner = shape_inside(hull, cameras, masks)
    assert not (inner.occupancy & ~hull.occupancy).any()
    assert 0.3 < inner.voxels / hull.voxels < 0.95
    assert np.array_equal(inner.bounds, hull.bounds)


@pytest.mark.parametrize("resolution", [None, 32])
@pytest.mark.parametrize("views", [3, 4, 9])
def test_covers_of_every_mask_what_the_hull_covers(views, resolution):
    cameras = ring(views)
    masks = ball_masks(cameras, BALLS)
    hull = carve(cameras, masks)
    inner = shape_inside(hull, cameras, masks, config=InsideConfig(resolution=resolution))
    before, after = (measure_coverage(shape, cameras, masks) for shape in (hull, inner))
    for a, b, said in zip(before, after, inner.summary["coverage"], strict=True):
        assert b.covered > a.covered - 0.005
        assert said == pytest.approx(b.covered, abs=0.005)


def test_a_pixel_wide_line_stays_covered():
    cameras = ring(4)
    masks = ball_masks(cameras, BALLS[:1])
    bars = ball_masks(cameras, [((0.0, 0.0, z), 0.02) for z in np.linspace(0.8, 1.5, 60)])
    masks = [m | b for m, b in zip(masks, bars, strict=True)]
    hull = carve(cameras, masks, resolution=96)
    inner = shape_inside(hull, cameras, masks)
    for view, bar in enumerate(bars):
        thin = [bar & masks[view]]
        (before,), (after,) = (measure_coverage(s, cameras[view : view + 1], thin) for s in (hull, inner))
        assert before.covered > 0.5
        assert after.covered > before.covered - 0.005


def test_a_ball_seen_by_few_comes_closer_to_the_ball():
    cameras = ring(4)
    hull = carve(cameras, ball_masks(cameras, BALLS[:1]))
    inner = shape_inside(hull, cameras, ball_masks(cameras, BALLS[:1]))
    centres = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in hull.shape), indexing="ij"), -1)
    ball = np.linalg.norm(hull.bounds[0] + centres * hull.voxel_edges, axis=-1) < BALLS[0][1]
    assert overlap(inner.occupancy, ball) > overlap(hull.occupancy, ball) + 0.02


def test_unseen_views_of_the_built_in_scene_fit_better(built_in):
    scene, hull, inner = built_in
    cameras, masks = scene.test.cameras[:6], list(scene.test.masks[:6])

    def fit(shape):
        found = measure_coverage(shape, cameras, masks)
        return np.mean([c.covered * c.inside / (c.covered + c.inside - c.covered * c.inside) for c in found])

    assert fit(inner) > fit(hull) + 0.08


def test_thin_parts_of_the_built_in_scene_survive(built_in):
    import cv2

    scene, hull, inner = built_in
    thin = []
    for mask in scene.train.masks:
        whole = mask.numpy().astype(np.uint8)
        edge = whole.shape[0] // 16
        opened = cv2.morphologyEx(
            whole, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge,) * 2)
        )
        thin.append((whole > 0) & (opened == 0))
        assert thin[-1].sum() > 50
    before, after = (measure_coverage(shape, scene.train.cameras, thin) for shape in (hull, inner))
    for a, b in zip(before, after, strict=True):
        assert b.covered > a.covered - 0.005


@pytest.mark.parametrize(
    ("scale", "shift"), [(1e-3, (0, 0, 0)), (1e3, (0, 0, 0)), (1.0, (1e5, -1e5, 1e5)), (7.0, (-3, 100, 20))]
)
def test_scale_and_shift_of_the_scene_change_nothing(capture, scale, shift):
    cameras, masks, hull = capture
    there = Hull(hull.occupancy.copy(), scale * hull.bounds + np.array(shift), dict(hull.summary))
    inner = shape_inside(hull, cameras, masks)
    again = shape_inside(there, moved(cameras, np.eye(3), scale, np.array(shift, float)), masks)
    assert overlap(inner.occupancy, again.occupancy) > 0.999


def test_a_turned_scene_gives_the_turned_shape(capture):
    cameras, masks, hull = capture
    turn = matrix_from_quaternion(torch.tensor([0.9, 0.2, -0.3, 0.4]).double()).numpy()
    inner = shape_inside(hull, cameras, masks)
    there = moved(cameras, turn, 1.0, np.zeros(3))
    again = shape_inside(carve(there, masks), there, masks)
    here = inner.sample_points(4000, torch.Generator().manual_seed(0)).numpy()
    back = again.sample_points(4000, torch.Generator().manual_seed(0)).numpy() @ turn
    for shape, points in ((again, here @ turn.T), (inner, back)):
        assert shape.contains(points, margin_voxels=1).mean() > 0.9
        assert shape.contains(points, margin_voxels=2).mean() > 0.995
    assert again.volume == pytest.approx(inner.volume, rel=0.02)


def test_a_larger_radius_rounds_more(capture):
    cameras, masks, hull = capture
    volumes = [
        shape_inside(hull, cameras, masks, config=InsideConfig(radius=r)).voxels for r in (0.1, 0.4, 1.6)
    ]
    assert volumes == sorted(volumes, reverse=True) and len(set(volumes)) == 3


def test_the_same_bits_for_any_number_of_threads(capture):
    cameras, masks, hull = capture
    threads = torch.get_num_threads()
    shapes = []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            shapes.append(shape_inside(hull, cameras, masks))
    finally:
        torch.set_num_threads(threads)
    assert shapes[0] == shapes[1] == shapes[2]


def test_it_is_a_hull_like_any_other(capture, tmp_path):
    cameras, masks, hull = capture
    inner = shape_inside(hull, cameras, masks)
    inner.save(tmp_path / "inner.npz")
    again = Hull.load(tmp_path / "inner.npz")
    assert again == inner and again.summary == inner.summary
    assert again.summary["kind"] == "inside" and again.summary["k"] == hull.summary["k"]
    assert is_closed(inner.to_mesh()[1])
    assert inner.contains(inner.sample_inside(100, torch.Generator().manual_seed(0))).all()


def test_two_views_are_refused():
    cameras = ring(2)
    masks = ball_masks(cameras, BALLS[:1])
    with pytest.raises(ConfigError, match="2 views"):
        shape_inside(carve(cameras, masks, k=2), cameras, masks)


@pytest.mark.parametrize("fields", [{"k": 1}, {"kind": "traditional"}, {"kind": "unit-sphere"}])
def test_hulls_that_one_view_was_enough_for_are_refused(fields):
    cameras = ring(4)
    masks = ball_masks(cameras, BALLS[:1])
    with pytest.raises(ConfigError, match="k of 2 or more"):
        shape_inside(carve(cameras, masks, **fields), cameras, masks)


def test_empty_hulls_and_flat_voxels_are_refused(capture):
    cameras, masks, hull = capture
    with pytest.raises(EmptyHullError):
        shape_inside(Hull(np.zeros((8, 8, 8), bool), hull.bounds), cameras, masks)
    flat = hull.bounds * np.array([1, 1, 0.5])
    with pytest.raises(ConfigError, match="cubes"):
        shape_inside(replace(hull, bounds=flat), cameras, masks)


@pytest.mark.parametrize("fields", [{"radius": 0}, {"radius": -1.0}, {"resolution": 4}, {"steps": 0}])
def test_settings_out_of_range_are_refused(fields):
    with pytest.raises(ConfigError, match=next(iter(fields))):
        InsideConfig(**fields)
