"""The flow's kernels against slow, obvious twins, and what a step does to shapes that are known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.ndimage import convolve1d

from tests.hull.balls import ball_masks, ring
from visdom_plugin.hull.carving.votes import Grid, gather_silhouettes
from visdom_plugin.hull.inside.diffusion import RAMP, SIGMA, blur_weights, cut_level, diffuse
from visdom_plugin.hull.inside.pyramid import pool, refine
from visdom_plugin.hull.inside.silhouette_rays import choose_pixels, draw_rays, find_met, give_back

BALLS = [((0.0, 0.0, 0.0), 0.8), ((0.7, 0.3, 0.5), 0.4)]


def step(u, cap, radius):
    u, half, blurred = u.copy(), np.empty_like(u), np.empty_like(u)
    diffuse(u, cap, radius, half, blurred)
    return u, blurred


def voxels_on(origin, direction, shape) -> list[tuple[int, int, int]]:
    """Voxels a ray goes through, in order: from every crossing of a plane to the next."""
    times = [0.0]
    for a in range(3):
        if direction[a]:
            times += [t for t in (np.arange(shape[a] + 1) - origin[a]) / direction[a] if t > 0]
    times = sorted(times)
    found = []
    for t0, t1 in itertools.pairwise(times):
        voxel = tuple(np.floor(origin + (t0 + t1) / 2 * direction).astype(int))
        if t1 - t0 > 1e-12 and all(0 <= v < n for v, n in zip(voxel, shape, strict=True)):
            found.append(voxel)
    return found


@pytest.fixture
def rays_and_grid():
    cameras = ring(3, size=24)
    masks = ball_masks(cameras, BALLS)
    grid = Grid(np.array([-1.1, -0.9, -0.95]), 0.17, (13, 11, 12))
    return draw_rays(cameras, gather_silhouettes(cameras, masks), grid), grid


def test_a_step_is_blur_cut_and_cap():
    random = np.random.default_rng(0)
    u = random.random((9, 14, 11), np.float32)
    cap = (random.random(u.shape) < 0.8).astype(np.uint8)
    moved, blurred = step(u, cap, 5.0)
    wanted = u.astype(float)
    for axis in range(3):
        wanted = convolve1d(wanted, blur_weights().astype(float), axis=axis, mode="constant")
    np.testing.assert_allclose(blurred, wanted, atol=2e-6)
    share = math.erf(RAMP / 2 / SIGMA / math.sqrt(2))
    cut = np.clip(0.5 + (wanted - cut_level(5.0)) / share, 0, 1) * cap
    np.testing.assert_allclose(moved, cut, atol=2e-6)


@pytest.mark.parametrize("radius", [10.0, 14.0])
def test_balls_grow_above_r_and_shrink_below_as_the_energy_says(radius):
    centre = np.stack(np.meshgrid(*[np.arange(48) - 23.5] * 3, indexing="ij"), -1)
    distance = np.linalg.norm(centre, axis=-1)
    cap = np.ones((48,) * 3, np.uint8)

    def growth(ball):
        u = np.clip(0.5 + (ball - distance) / RAMP, 0, 1).astype(np.float32)
        sizes = []
        for _ in range(20):
            u, _ = step(u, cap, radius)
            sizes.append((3 * u.sum(dtype=float) / (4 * np.pi)) ** (1 / 3))
        return (sizes[-1] - sizes[4]) / 15

    for ball in (0.7 * radius, radius, 1.4 * radius):
        assert growth(ball) == pytest.approx(SIGMA**2 * (1 / radius - 1 / ball), abs=0.012)


def test_pool_and_refine_keep_places():
    random = np.random.default_rng(1)
    grid = random.random((13, 8, 9)) < 0.1
    small = pool(grid, 4)
    for index in np.ndindex(small.shape):
        block = grid[tuple(slice(4 * i, 4 * i + 4) for i in index)]
        assert small[index] == block.any()
    ramp = np.broadcast_to(np.arange(6, dtype=np.float32)[:, None, None], (6, 4, 5)).copy()
    fine = refine(ramp, (11, 8, 10))
    assert fine.shape == (11, 8, 10)
    np.testing.assert_allclose(fine[1:11, 3, 3], (np.arange(1, 11) - 0.5) / 2)


@pytest.mark.parametrize("edge", [1, 3, 4])
def test_every_square_with_foreground_has_its_most_central_pixel(edge):
    mask = np.random.default_rng(2).random((17, 22)) < 0.15
    squares, rows, columns = choose_pixels(mask, edge)
    assert mask[rows, columns].all()
    wide = -(-22 // edge)
    assert np.array_equal(squares, rows // edge * wide + columns // edge)
    held = {(y // edge, x // edge) for y, x in zip(*np.nonzero(mask), strict=True)}
    assert len(held) == len(squares)
    for row, column in zip(rows, columns, strict=True):
        y, x = row // edge * edge, column // edge * edge
        ys, xs = np.nonzero(mask[y : y + edge, x : x + edge])
        middle = (edge - 1) / 2
        assert np.hypot(ys - middle, xs - middle).min() == np.hypot(row - y - middle, column - x - middle)


def test_rays_go_through_the_voxels_they_cross(rays_and_grid):
    rays, grid = rays_and_grid
    u = (np.random.default_rng(3).random(grid.shape) < 0.03).astype(np.float32)
    state = find_met(rays, u.astype(np.uint8))
    for n in range(len(rays)):
        met = any(u[v] for v in voxels_on(rays.origins[rays.views[n]], rays.directions[n], grid.shape))
        assert state[rays.squares[n]] == (1 if met else 2)
    assert np.count_nonzero(state) == len(rays) and {1, 2} <= set(state)


def test_a_ray_that_misses_gets_the_voxel_of_most_views_for_least_energy(rays_and_grid):
    rays, grid = rays_and_grid
    random = np.random.default_rng(4)
    cap = (random.random(grid.shape) < 0.7).astype(np.uint8)
    rays = rays.that_meet(cap)
    u = ((random.random(grid.shape) < 0.03) & (cap > 0)).astype(np.float32)
    blurred, cut = random.random(grid.shape).astype(np.float32), 0.4
    state, wanted, missed = find_met(rays, u.astype(np.uint8)), u.copy(), 0
    for n in range(len(rays)):
        if state[rays.squares[n]] == 1:
            continue
        missed += 1
        best = None
        for voxel in voxels_on(rays.origins[rays.views[n]], rays.directions[n], grid.shape):
            worth = 0
            for view, p in enumerate(rays.projections):
                x, y, w = p @ np.append(np.array(voxel) + 0.5, 1)
                column, row = math.floor(x / w), math.floor(y / w)
                inside = 0 <= column < rays.sizes[view, 0] and 0 <= row < rays.sizes[view, 1]
                place = rays.starts[view] + row * rays.sizes[view, 0] + column
                worth += view == rays.views[n] or (inside and state[place] == 2)
            score = worth / (0.05 + max(cut - blurred[voxel], 0))
            if cap[voxel] and (best is None or score > best[0]):
                best = score, voxel
        wanted[best[1]] = 1
    assert missed > 20
    assert give_back(rays, u, cap, blurred, cut) == missed
    assert np.array_equal(u, wanted)
    assert give_back(rays, u, cap, blurred, cut) == 0


def test_what_is_given_is_a_ball_within_the_cap(rays_and_grid):
    rays, grid = rays_and_grid
    cap = np.ones(grid.shape, np.uint8)
    cap[:, 5] = 0
    u = np.zeros(grid.shape, np.float32)
    blurred = np.zeros(grid.shape, np.float32)
    blurred[6, 6, 6] = 0.5
    one = rays.that_meet((blurred > 0).view(np.uint8))
    give_back(one, u, cap, blurred, 0.5, ball=2.0)
    centre = np.stack(np.meshgrid(*(np.arange(n) - 6 for n in grid.shape), indexing="ij"), -1)
    assert np.array_equal(u > 0, ((centre**2).sum(-1) <= 4) & (cap > 0))
