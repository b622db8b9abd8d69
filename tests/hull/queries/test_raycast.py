"""Rays against voxels: exact crossings, with the slow slab test of every voxel as the twin."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hull.balls import ring
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.bricks import build_bricks
from visdom_plugin.hull.queries.raycast import cast, cast_with_torch, depth_and_silhouette


def slow_cast(hull: Hull, origins, directions):
    """Each ray against each occupied voxel's box."""
    low = hull.bounds[0] + np.argwhere(hull.occupancy) * hull.voxel_edges
    high = low + hull.voxel_edges
    first, last = np.zeros(len(origins)), np.zeros(len(origins))
    thickness = np.full(len(origins), -1.0)
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - o) / d, (high - o) / d])
        beside = ((d == 0) & ((o < low) | (o >= high))).any(1)
        near = np.where(d == 0, -np.inf, ends.min(0)).max(1).clip(0)
        far = np.where(beside, -np.inf, np.where(d == 0, np.inf, ends.max(0)).min(1))
        met = near < far
        if met.any():
            first[i], last[i], thickness[i] = near[met].min(), far[met].max(), (far - near)[met].max()
    return first, last, thickness


def random_hull(random, fill: float) -> Hull:
    shape = random.integers(1, 18, 3)
    grid = random.random(shape) < fill
    if random.random() < 0.5:
        grid &= (
            random.random(tuple(-(-shape // 6)))
            .repeat(6, 0)
            .repeat(6, 1)
            .repeat(6, 2)[tuple(map(slice, shape))]
            < 0.3
        )
    low = random.normal(size=3)
    return Hull(grid, np.stack([low, low + shape * random.choice([0.01, 0.3, 2.0])]))


def random_rays(random, hull: Hull, n: int):
    size = hull.bounds[1] - hull.bounds[0]
    origins = hull.bounds.mean(0) + random.normal(size=(n, 3)) * size * random.choice([0.2, 1.0, 4.0])
    target = hull.bounds[0] + random.random((n, 3)) * size
    directions = (target - origins) * random.uniform(0.2, 3, (n, 1))
    flat = random.random((n, 3)) < 0.15
    directions[flat] = 0
    directions[(directions == 0).all(1)] = [0, 0, -1]
    return origins, directions


@given(st.integers(0, 10**9), st.sampled_from([0.01, 0.2, 0.8]))
@settings(max_examples=50, deadline=None)
def test_cast_meets_what_the_slab_test_meets(seed, fill):
    random = np.random.default_rng(seed)
    hull = random_hull(random, fill)
    origins, directions = random_rays(random, hull, 25)
    first, last, thickness = slow_cast(hull, origins, directions)
    crossing = cast(hull, origins, directions)
    # A ray that only grazes an edge may go either way.
    clear = (thickness > 1e-9) | (thickness < 0)
    assert np.array_equal(crossing.hit.numpy()[clear], (thickness > 0)[clear])
    both = clear & (thickness > 0)
    size = hull.voxel_size / np.linalg.norm(directions, axis=1)
    assert (np.abs(crossing.t_first.numpy() - first) <= 1e-6 * size)[both].all()
    assert (np.abs(crossing.t_last.numpy() - last) <= 1e-6 * size)[both].all()
    miss = ~crossing.hit
    assert (crossing.t_first[miss] == 0).all() and (crossing.t_last[miss] == 0).all()


@given(st.integers(0, 10**9), st.sampled_from([0.01, 0.2, 0.8]))
@settings(max_examples=40, deadline=None)
def test_torch_march_equals_numba_walk(seed, fill):
    random = np.random.default_rng(seed)
    hull = random_hull(random, fill)
    origins, directions = (torch.from_numpy(x) for x in random_rays(random, hull, 200))
    walked, marched = cast(hull, origins, directions), cast_with_torch(hull, origins, directions)
    half_voxel = 0.5 * hull.voxel_size / directions.norm(dim=-1)
    assert (walked.hit != marched.hit).sum() <= 1
    same = walked.hit & marched.hit
    assert ((walked.t_first - marched.t_first).abs() <= half_voxel)[same].all()
    assert ((walked.t_last - marched.t_last).abs() <= half_voxel)[same].all()


@given(st.integers(0, 10**9))
@settings(max_examples=20, deadline=None)
def test_empty_cubes_ahead_are_the_largest(seed):
    random = np.random.default_rng(seed)
    grid = random.random(random.integers(1, 40, 3)) < 0.0005
    bricks = build_bricks(grid)
    full = np.argwhere(bricks.bits != 0)
    everywhere = np.stack(np.meshgrid(*map(np.arange, bricks.bits.shape), indexing="ij"), -1)
    for octant, ahead in enumerate(bricks.ahead):
        sign = 1 - 2 * (octant >> np.arange(3) & 1)
        for edge, brick in zip(ahead.reshape(-1), everywhere.reshape(-1, 3), strict=True):
            offsets = (full - brick) * sign
            offsets = offsets[(offsets >= 0).all(1)]
            assert edge == (offsets.max(1).min() if len(offsets) else 255)
    assert sum(int(b).bit_count() for b in bricks.bits.reshape(-1)) == grid.sum()


def test_every_ray_alone_gives_the_same_bits():
    random = np.random.default_rng(3)
    hull = random_hull(random, 0.1)
    origins, directions = (torch.from_numpy(x) for x in random_rays(random, hull, 3000))
    together = cast(hull, origins, directions)
    for rows in (slice(0, 1), slice(700, 1100), slice(2999, 3000)):
        alone = cast(hull, origins[rows], directions[rows])
        assert all(torch.equal(a, b[rows]) for a, b in zip(alone, together, strict=True))
    assert together.hit.any()


def test_an_origin_inside_enters_at_zero():
    hull = Hull.from_grid(np.ones((8, 8, 8), bool), [[0, 0, 0], [8, 8, 8]])
    crossing = cast(hull, torch.full((5, 3), 4.0), torch.eye(3)[[0, 1, 2, 0, 1]] * 2)
    assert (
        crossing.hit.all()
        and (crossing.t_first == 0).all()
        and torch.allclose(crossing.t_last, torch.tensor(2.0))
    )


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (2, 0)])
def test_any_leading_shape_and_broadcast(shape):
    hull = Hull.from_grid(np.ones((4, 4, 4)), [[-1] * 3, [1] * 3])
    directions = torch.ones(*shape, 3)
    crossing = cast(hull, torch.tensor([-3.0, -3, -3]), directions)
    assert crossing.hit.shape == crossing.t_first.shape == shape and crossing.hit.all()
    assert torch.allclose(crossing.t_first, torch.tensor(2.0)) and torch.allclose(
        crossing.t_last, torch.tensor(4.0)
    )


def test_rays_without_direction_and_nan_miss():
    hull = Hull.from_grid(np.ones((4, 4, 4)), [[-1] * 3, [1] * 3])
    directions = torch.tensor([[0.0, 0, 0], [torch.nan, 1, 0], [1, 0, 0]])
    assert cast(hull, torch.zeros(3), directions).hit.tolist() == [False, False, True]
    assert not cast(hull, torch.full((1, 3), torch.nan), torch.ones(1, 3)).hit.any()


def test_an_empty_hull_is_never_met():
    hull = Hull(np.zeros((5, 6, 7), bool), np.array([[-1.0] * 3, [1.0] * 3]))
    origins, directions = torch.randn(50, 3), torch.randn(50, 3)
    assert (
        not cast(hull, origins, directions).hit.any()
        and not cast_with_torch(hull, origins, directions).hit.any()
    )


def test_depth_and_silhouette_agree_with_cast():
    grid = np.zeros((20, 20, 20), bool)
    grid[4:15, 6:12, 3:18] = True
    hull = Hull.from_grid(grid, [[-1] * 3, [1] * 3])
    camera = ring(3)[1]
    depth, mask = depth_and_silhouette(hull, camera)
    from visdom_plugin.geometry.cameras import rays_of

    rays = rays_of(camera)
    crossing = cast(hull, rays.origins, rays.directions)
    assert torch.equal(mask, crossing.hit) and 0 < mask.float().mean() < 1
    along = (rays.directions * camera.forward).sum(-1)
    assert torch.allclose(depth.double(), crossing.t_first * along, atol=1e-5)


def test_cast_keeps_dtype():
    hull = Hull.from_grid(np.ones((4, 4, 4)), [[-1] * 3, [1] * 3])
    assert cast(hull, torch.zeros(2, 3), torch.ones(2, 3)).t_first.dtype == torch.float32
    assert cast(hull, np.zeros((2, 3)), np.ones((2, 3))).t_first.dtype == torch.float64
