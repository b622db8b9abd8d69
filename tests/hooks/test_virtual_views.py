"""Views between the training cameras: where they stand, and their rays along which there is nothing."""

import pickle

import pytest
import torch

from visdom_plugin import Hull, VisDomSampler, VisibleDomain
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import pixel_radius
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import EmptySpace, empty_spaces
from visdom_plugin.hooks.virtual_views import VIEWS, midpoint_views, nearest_pairs, virtual_views
from visdom_plugin.hull.queries.raycast import cast
from visdom_plugin.scene import Views

from .test_regularizer import CENTRE, SIZE, capture

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ball():
    cameras, masks = capture()
    return cameras, VisibleDomain(k=3, resolution=64).carve(cameras, masks)


@pytest.mark.parametrize("n", [2, 3, 5, 9])
def test_pairs_are_each_camera_with_its_two_nearest(n):
    cameras, _ = capture(n)
    wanted = set()
    for i in range(n):
        others = sorted(
            (j for j in range(n) if j != i),
            key=lambda j: float((cameras.centres[i] - cameras.centres[j]).norm()),
        )
        wanted |= {frozenset((i, j)) for j in others[:2]}
    pairs = nearest_pairs(cameras)
    assert {frozenset(p) for p in pairs} == wanted and len(pairs) == len(wanted)
    assert n == 2 or n <= len(pairs) <= 2 * n


def test_midpoint_views_are_halfway_in_place_and_in_turn():
    cameras, _ = capture()
    for (i, j), view in zip(nearest_pairs(cameras), midpoint_views(cameras), strict=True):
        torch.testing.assert_close(view.centres, (cameras.centres[i] + cameras.centres[j]) / 2)
        turns = [view.world_from_camera[:3, :3].T @ cameras.world_from_camera[k, :3, :3] for k in (i, j)]
        angles = [((turn.trace() - 1) / 2).acos() for turn in turns]
        whole = cameras.world_from_camera[i, :3, :3].T @ cameras.world_from_camera[j, :3, :3]
        torch.testing.assert_close(angles[0], angles[1])
        torch.testing.assert_close(angles[0] + angles[1], ((whole.trace() - 1) / 2).acos())
        assert torch.equal(view.intrinsics, cameras[0].intrinsics) and view.size == (SIZE, SIZE)


def test_views_between_are_the_same_every_time():
    cameras, _ = capture()
    first, second = (virtual_views(cameras, "between", CENTRE) for _ in range(2))
    assert len(first) == VIEWS
    assert all(
        torch.equal(a.world_from_camera, b.world_from_camera) for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("kind", ["between", "midpoints"])
def test_empty_rays_start_at_every_virtual_view_and_miss_the_hull(ball, kind):
    cameras, hull = ball
    sampler = VisDomSampler(hull, cameras=cameras, virtual_views=kind, virtual_rays=0.5)
    assert isinstance(sampler, EmptySpace) and empty_spaces([sampler]) == [sampler]
    rays = sampler.empty_rays(8000, torch.Generator().manual_seed(0))
    assert rays.origins.shape == rays.directions.shape == (4000, 3) and rays.radii.shape == (4000,)
    assert not cast(hull, *rays[:2]).hit.any()
    views = virtual_views(cameras, kind, torch.as_tensor(hull.centre))
    places = torch.stack([v.centres for v in views]).float()
    apart = torch.cdist(rays.origins.double(), places.double())
    assert apart.min(-1).values.max() < 1e-5
    assert apart.argmin(-1).unique().numel() == len(views)
    torch.testing.assert_close(rays.radii, pixel_radius(views[0]).expand(4000), rtol=0.2, atol=0)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(4000))
    # Some pass close by: what a band around the hull leaves open is asked about, too.
    closest = torch.linalg.cross(CENTRE.float() - rays.origins, rays.directions).norm(dim=-1)
    assert closest.min() < 1.3 * hull.radius


def test_a_large_view_is_asked_about_at_fewer_places(ball):
    cameras, hull = ball
    small, large = (
        VisDomSampler(hull, cameras=cameras.resized(s, s), virtual_views="midpoints") for s in (256, 700)
    )
    a, b = (s.empty_rays(400, torch.Generator().manual_seed(0)) for s in (small, large))
    torch.testing.assert_close(a.directions, b.directions)
    torch.testing.assert_close(a.radii / b.radii, torch.full_like(a.radii, 700 / 256))


def test_rays_come_of_the_generator_alone_and_survive_pickling(ball):
    cameras, hull = ball
    sampler = VisDomSampler(hull, cameras=cameras, virtual_views="between")
    first = sampler.empty_rays(64, torch.Generator().manual_seed(3))
    again = pickle.loads(pickle.dumps(sampler)).empty_rays(64, torch.Generator().manual_seed(3))
    other = sampler.empty_rays(64, torch.Generator().manual_seed(4))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.directions, other.directions)


def test_a_hull_that_fills_every_view_leaves_no_rays(ball):
    cameras, _ = ball
    hull = Hull.from_grid(torch.ones(8, 8, 8, dtype=torch.bool).numpy(), ((-20,) * 3, (20,) * 3))
    sampler = VisDomSampler(hull, cameras=cameras, virtual_views="midpoints")
    assert len(sampler.empty_rays(100).origins) == 0


def test_off_by_default_and_refused_where_it_cannot_be(ball):
    cameras, hull = ball
    views = Views(cameras, [], [], [])
    assert not empty_spaces([SamplerConfig(enabled=True).build(hull, views), VisDomSampler(hull)])
    assert empty_spaces([SamplerConfig(enabled=True, virtual_views="between").build(hull, views)])
    with pytest.raises(ConfigError, match="no virtual views"):
        VisDomSampler(hull, cameras=cameras).empty_rays(4)
    with pytest.raises(ConfigError, match="at least two"):
        VisDomSampler(hull, virtual_views="between")
    with pytest.raises(ConfigError, match="at least two"):
        VisDomSampler(hull, cameras=cameras[:1], virtual_views="midpoints")
    for bad in ({"virtual_views": "some"}, {"virtual_weight": -1.0}, {"virtual_rays": 0.0}):
        with pytest.raises(ConfigError, match="virtual_rays above 0"):
            VisDomSampler(hull, cameras=cameras, **bad)
