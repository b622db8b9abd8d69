"""Distances to a known surface, and shared volume: laws that hold whatever the shape."""

import numpy as np
import pytest
import trimesh

from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.grid.mesh import mesh_grid
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.surface_distance import (
    compare_points,
    draw_on_surface,
    enclosed_volume,
    fill_mesh,
    overlap,
)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    return np.array(mesh.vertices), np.array(mesh.faces)


def _slow(target, hull):
    squares = ((target[:, None] - hull[None]) ** 2).sum(-1)
    return squares.min(1).mean(), squares.min(0).mean()


def test_distances_are_those_of_the_slow_twin(ball):
    a, b = draw_on_surface(*ball, 150, 1), 1.3 * draw_on_surface(*ball, 120, 2) + 0.2
    found = compare_points(a, b)
    assert found == pytest.approx(_slow(a, b), rel=1e-9)
    assert found.symmetric == pytest.approx(sum(_slow(a, b)))


def test_a_surface_is_close_to_itself_and_closer_the_more_points(ball):
    floors = [
        compare_points(draw_on_surface(*ball, n, 0), draw_on_surface(*ball, n, 1)).symmetric
        for n in (500, 8000)
    ]
    # Of n points spread at random over area A the nearest is at a mean squared distance of A / (pi n).
    assert floors == pytest.approx([2 * 4 / n for n in (500, 8000)], rel=0.2)
    points = draw_on_surface(*ball, 500, 0)
    assert compare_points(points, points).symmetric == 0


def test_exchange_scale_and_motion(ball):
    a, b = draw_on_surface(*ball, 2000, 0), 1.2 * draw_on_surface(*ball, 2000, 1)
    found, turned = compare_points(a, b), compare_points(b, a)
    assert found.symmetric == turned.symmetric and found.target_to_hull == turned.hull_to_target
    motion = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.7]))[:3, :3]
    moved = [7.0 * x @ motion.T + [3.0, -2.0, 5.0] for x in (a, b)]
    assert compare_points(*moved) == pytest.approx([49 * x for x in found], rel=1e-9)
    # Concentric spheres 0.2 apart.
    assert found == pytest.approx((0.04, 0.04), rel=0.1)


def test_points_lie_evenly_on_the_surface(ball):
    vertices, faces = ball
    points = draw_on_surface(vertices, faces, 20_000, 3)
    assert (np.linalg.norm(points, axis=1) > 0.99).all() and (np.linalg.norm(points, axis=1) < 1.0001).all()
    assert abs(points.mean(0)).max() < 0.03
    assert np.array_equal(points, draw_on_surface(vertices, faces, 20_000, 3))
    with pytest.raises(ConfigError, match="without area"):
        draw_on_surface(vertices, faces[:0], 10, 0)


def test_filling_a_grids_surface_gives_the_grid_back():
    random = np.random.default_rng(0)
    for shape in ((9, 14, 11), (1, 5, 3)):
        grid = random.random(shape) < 0.5
        vertices, faces = mesh_grid(grid)
        lower, edge = np.array([3.0, -2.0, 0.5]), 0.25
        bounds = np.stack([lower, lower + edge * np.array(shape)])
        assert np.array_equal(fill_mesh(lower + edge * vertices, faces, bounds, shape), grid)


def test_volume_inside_and_shared(ball):
    vertices, faces = ball
    assert enclosed_volume(vertices, faces) == pytest.approx(trimesh.Trimesh(*ball).volume)
    n = 60
    axis = (np.arange(n) + 0.5) / n * 3 - 1.5
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    bounds = ((-1.5,) * 3, (1.5,) * 3)
    for radius in (0.8, 1.0, 1.25):
        found = overlap(Hull.from_grid(x**2 + y**2 + z**2 < radius**2, bounds), vertices, faces)
        small, large = sorted([radius**3, 1.0])
        assert found["iou"] == pytest.approx(small / large, abs=0.03)
        assert found["covered"] == pytest.approx(min(radius**3, 1.0), abs=0.03)
        assert found["volume"] / found["target_volume"] == pytest.approx(radius**3, rel=0.03)
    ball = Hull.from_grid(x**2 + y**2 + z**2 < 1, bounds)
    itself = overlap(ball, *ball.to_mesh())
    assert 0.97 < itself["iou"] <= itself["covered"] <= 1
    half = overlap(Hull.from_grid(x > 0, bounds), vertices, faces)
    assert half["covered"] == pytest.approx(0.5, abs=0.01)
    assert overlap(Hull.from_grid(x > 0, bounds), vertices, faces[1:])["iou"] is None
