"""Points in the shell below a hull's surface."""

import numpy as np
import pytest
import torch

from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.shell_points import DEEP, DEPTH, sample_shell


@pytest.fixture(scope="module")
def ball():
    """A ball of radius 1 around (5, -2, 1), 80 voxels across, and a rod of 2 voxels that sticks out of it."""
    grid = (np.indices((120, 80, 80)).transpose(1, 2, 3, 0) + 0.5) / 40 - 1
    occupancy = (grid**2).sum(-1) < 1
    occupancy[80:116, 39:41, 39:41] = True
    return Hull(occupancy, np.array([[4.0, -3, 0], [7, -1, 2]]))


def draw(hull, n=20_000, seed=0):
    return sample_shell(hull, n, torch.Generator().manual_seed(seed))


def test_all_lie_inside_the_same_ones_for_a_seed(ball):
    points = draw(ball)
    assert points.shape == (20_000, 3) and ball.contains(points).all()
    assert torch.equal(points, draw(ball)) and not torch.equal(points, draw(ball, seed=1))


def test_the_density_falls_below_the_shell(ball):
    points = draw(ball, 100_000)
    depth = 1 - (points - torch.tensor([5.0, -2, 1])).norm(dim=-1)
    band = DEPTH * ball.radius
    inner, outer = 1 - 2 * band, 1 - band / 2
    # Away from the rod and from the edge of the shell, whose depth is known to a voxel.
    far = points[:, 0] < 5
    deep = (far & (depth > 1 - inner)).sum() / inner**3
    shallow = (far & (depth < 1 - outer) & (depth > 0.025)).sum() / ((1 - 0.025) ** 3 - outer**3)
    assert abs(float(deep / shallow) / DEEP - 1) < 0.05


def test_thin_parts_get_more_than_their_share_of_the_volume(ball):
    def share(points):
        return float((points[:, 0] > 6.05).double().mean())

    by_volume = share(ball.sample_inside(200_000, torch.Generator().manual_seed(0)))
    assert share(draw(ball, 200_000)) > 1.4 * by_volume > 0


def test_a_hull_that_fills_its_grid_has_a_surface_all_the_same():
    full = Hull(np.ones((40, 40, 40), bool), np.array([[0.0, 0, 0], [1, 1, 1]]))
    points = draw(full)
    near = (torch.minimum(points, 1 - points).amin(-1) < 0.5 * DEPTH * full.radius).double().mean()
    assert float(near) > 0.25


def test_an_empty_hull_has_none():
    assert len(draw(Hull(np.zeros((8, 8, 8), bool), np.array([[0.0, 0, 0], [1, 1, 1]])), 5)) == 0
