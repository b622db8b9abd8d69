"""The occupancy grid and marching through it: definitions, the torch twin, thread counts."""

import pytest
import torch

from visdom_plugin.nerf.sampling.occupancy_grid import (
    OccupancyGrid,
    _march_torch,
    _middles_torch,
    intersect_cube,
    march_occupied,
    middles_of,
)
from visdom_plugin.seeding import generator


def make_rays(n=300, seed=0):
    g = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1) * 2
    targets = 1.6 * torch.rand(n, 3, generator=g) - 0.8
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    enter, leave = intersect_cube(origins, directions, 1.0)
    step = 0.02 + 0.1 * torch.rand(n, generator=g)
    return origins, directions, enter, leave, step, torch.rand(n, generator=g)


def ball_density(points):
    return torch.where(points.norm(dim=-1) < 0.5, 20.0, 0.0)


@pytest.fixture
def grid():
    found = OccupancyGrid(16, 1.0, threshold=1.0)
    # The threshold is at most the mean; full looks at random points settle which cells the ball touches.
    for i in range(30):
        found.update(ball_density, generator(0, i), fraction=1.0)
    return found


def test_cube_entries_and_exits_lie_on_its_faces():
    origins, directions, enter, leave, *_ = make_rays()
    assert (enter < leave).all()
    for t in (enter, leave):
        assert torch.allclose((origins + t[:, None] * directions).abs().amax(-1), torch.ones(300), atol=1e-5)
    inside, axis = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    assert [float(x) for x in intersect_cube(inside, axis, 1.0)] == [0.0, 1.0]
    enter, leave = intersect_cube(torch.tensor([[0.0, 3.0, 0.0]]), axis, 1.0)
    assert enter >= leave


def test_cells_of_the_ball_are_occupied_and_far_ones_are_not(grid):
    axis = (torch.arange(16) + 0.5) / 8 - 1
    centres = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1)
    half_diagonal = 3**0.5 / 16
    assert grid.occupied[centres < 0.5 - half_diagonal].all()
    assert not grid.occupied[centres > 0.5 + half_diagonal].any()


def test_what_vanished_fades_by_the_decay(grid):
    before = grid.density.clone()
    for i in range(10):
        grid.update(lambda points: torch.zeros(len(points)), generator(1, i), fraction=1.0)
    torch.testing.assert_close(grid.density, before * 0.95**10)


def test_few_cells_at_a_time_find_the_same_ball():
    grid = OccupancyGrid(12, 1.0, threshold=1.0)
    whole = OccupancyGrid(12, 1.0, threshold=1.0)
    for i in range(150):
        grid.update(ball_density, generator(2, i), fraction=0.2)
        whole.update(ball_density, generator(2, i), fraction=1.0)
    both = (grid.occupied & whole.occupied).sum() / (grid.occupied | whole.occupied).sum()
    assert both > 0.9


def test_march_is_its_definition(grid):
    origins, directions, near, far, step, shift = rays = make_rays()
    samples = march_occupied(*rays, grid)
    n = grid.resolution
    for r in range(0, 300, 7):
        expected, i = [], 0
        while True:
            begin = near[r] + (i + shift[r]) * step[r]
            middle = begin + 0.5 * step[r]
            if middle >= far[r]:
                break
            cell = ((origins[r] + middle * directions[r] + 1) * (n / 2)).floor().long()
            if ((cell >= 0) & (cell < n)).all() and grid.occupied[tuple(cell)]:
                expected.append(float(begin))
            i += 1
        a, b = samples.ray_offsets[r : r + 2].tolist()
        assert (samples.ray[a:b] == r).all()
        assert samples.starts[a:b].tolist() == pytest.approx(expected, abs=1e-5)
    assert torch.allclose(samples.ends - samples.starts, step[samples.ray])


@pytest.mark.parametrize("finer", [1, 40])
def test_march_equals_its_torch_twin_and_any_number_of_threads(grid, finer):
    *rays, step, shift = make_rays(2000 // finer, seed=3)
    rays += [step / finer, shift]
    one, twin = march_occupied(*rays, grid), _march_torch(*rays, grid)
    # Rounding may put a middle on the other side of a cell's face.
    assert abs(len(one.ray) - len(twin.ray)) <= 2 * finer**0.5
    if len(one.ray) == len(twin.ray):
        assert torch.allclose(one.starts, twin.starts, atol=1e-5)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        other = march_occupied(*rays, grid)
    finally:
        torch.set_num_threads(threads)
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


def test_middles_of_samples_equal_their_torch_twin(grid):
    rays = make_rays(700, seed=5)
    samples = march_occupied(*rays, grid)
    assert torch.equal(middles_of(*rays[:2], samples), _middles_torch(*rays[:2], samples))


@pytest.mark.parametrize("walk", [march_occupied, _march_torch])
def test_samples_of_rays_that_start_outside_are_those_within_the_cube(walk):
    draw = generator(6)
    origins = 3 * torch.rand(500, 3, generator=draw) - 1.5
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=draw), dim=-1)
    step, shift = torch.full((500,), 0.05), torch.rand(500, generator=draw)
    grid = OccupancyGrid(8, 1.0, threshold=1.0)
    found = walk(origins, directions, torch.zeros(500), torch.full((500,), 4.0), step, shift, grid)
    middles = (torch.arange(79) + 0.5 + shift[:, None]) * 0.05
    depth = 1 - (origins[:, None] + middles[..., None] * directions[:, None]).abs().amax(-1)
    counts = found.ray_offsets.diff()
    # On a face, rounding decides.
    assert ((depth > 1e-3).sum(1) <= counts).all() and (counts <= (depth > -1e-3).sum(1)).all()


def test_rays_cut_to_the_cube_are_sampled_to_their_ends():
    """Where they leave by a lower face, rounding may put the last middle outside."""
    origins, directions, _, leave, *_ = make_rays(20_000, seed=4)
    lower = (origins + leave[:, None] * directions).amin(-1) < -0.9999
    rays = [x[lower] for x in (origins, directions, leave - 0.01, leave)]
    step, shift = torch.full((len(rays[0]),), 0.01), torch.full((len(rays[0]),), 0.49999)
    samples = march_occupied(*rays, step, shift, OccupancyGrid(128, 1.0, threshold=1.0))
    assert lower.sum() > 5000 and (samples.ray_offsets.diff() == 1).all()


@pytest.mark.parametrize("walk", [march_occupied, _march_torch])
def test_no_rays_have_no_samples(grid, walk):
    offsets, ray, starts, ends = walk(*(x[:0] for x in make_rays()), grid)
    assert offsets.tolist() == [0] and (ray.dtype, starts.dtype) == (torch.int64, torch.float32)
    assert len(ray) == len(starts) == len(ends) == 0


def test_rays_beside_the_cube_reach_nothing():
    """Less than a cell away from each face, along it."""
    grid = OccupancyGrid(8, 1.0, threshold=1.0)
    away, along = 1.1 * torch.cat([torch.eye(3), -torch.eye(3)]), torch.eye(3).roll(1, 0).repeat(2, 1)
    grid.restrict(away - along, along, torch.zeros(6), torch.full((6,), 2.0))
    assert not grid.reachable.any()


def test_unsampled_cells_stay_empty_for_ever():
    origins, directions, near, far, *_ = make_rays(25)
    grid = OccupancyGrid(16, 1.0, threshold=1.0)
    half = 0.5 * (near + far)
    grid.restrict(origins, directions, near, half)
    for i in range(5):
        grid.update(lambda points: torch.full((len(points),), 9.0), generator(4, i), fraction=1.0)
    assert 0 < grid.occupied.sum() < grid.occupied.numel()
    assert torch.equal(grid.occupied, grid.reachable)
    t = near + torch.rand(25, generator=generator(5)) * (half - near)
    cells = ((origins + t[:, None] * directions + 1) * 8).floor().long().clamp(0, 15)
    assert grid.reachable[tuple(cells.T)].all(), "a place that rays sample was given up"


def test_state_round_trip(grid):
    other = OccupancyGrid(16, 1.0, threshold=1.0)
    other.load_state_dict({k: v.clone() for k, v in grid.state_dict().items()})
    for g in (grid, other):
        g.update(ball_density, generator(9), fraction=0.1)
    assert torch.equal(grid.density, other.density) and torch.equal(grid.occupied, other.occupied)
