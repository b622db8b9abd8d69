"""The sampler hook: its intervals by definition, purity, and foreign tensors."""

import copy
import pickle

import numpy as np
import pytest
import torch

from visdom_plugin import Hull, VisDomSampler
from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hooks.protocols import SampleFilter, SamplerHook, sample_filters
from visdom_plugin.hooks.settings import SamplerSettings
from visdom_plugin.hull.queries.raycast import cast
from visdom_plugin.scene import Views

from ..hull.balls import ring


@pytest.fixture(scope="module")
def hull():
    """Two separate balls off the origin, so that rays leave and enter again."""
    n = 48
    axis = (np.arange(n) + 0.5) / n * 4 - 1
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    grid = (x - 0.4) ** 2 + (y - 1) ** 2 + (z - 1) ** 2 < 0.4
    grid |= (x - 2) ** 2 + (y - 1) ** 2 + (z - 1) ** 2 < 0.25
    return Hull.from_grid(grid, ((-1, -1, -1), (3, 3, 3)))


@pytest.fixture(scope="module")
def rays():
    g = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(500, 3, generator=g), dim=-1) * 6 + 1
    targets = torch.rand(500, 3, generator=g) * 4 - 1
    directions = (targets - origins) * (0.2 + torch.rand(500, 1, generator=g))
    return origins, directions


@pytest.mark.parametrize("interval", ["first_hit", "entry_exit"])
@pytest.mark.parametrize("missing", ["full", "skip"])
def test_bounds_are_the_definition(hull, rays, interval, missing):
    origins, directions = rays
    sampler = VisDomSampler(hull, epsilon_world=0.3, interval=interval, missing=missing)
    near, far = torch.full((500,), 0.1), torch.full((500,), 9.0)
    bounds = sampler.bound(origins, directions, near, far)
    assert isinstance(sampler, SamplerHook)
    hits = 0
    for i in range(500):
        first, last, hit = (x.item() for x in cast(hull, origins[i], directions[i]))
        length = directions[i].norm().item()
        if hit:
            begin = max(0.1, first - 0.3 / length)
            end = min(9.0, (first if interval == "first_hit" else last) + 0.3 / length)
        else:
            begin, end = 0.1, 9.0 if missing == "full" else 0.1
        assert bounds.hit[i].item() == hit
        assert bounds.near[i].item() == pytest.approx(begin, abs=1e-4)
        assert bounds.far[i].item() == pytest.approx(end, abs=1e-4)
        hits += hit
    assert 100 < hits < 400


def test_every_point_of_the_hull_near_the_first_hit_can_be_sampled(hull, rays):
    """What the interval leaves out lies outside the hull, or deeper than epsilon behind the first hit."""
    origins, directions = rays
    near, far, hit = VisDomSampler(hull, epsilon_world=0.25, interval="entry_exit")(
        origins, directions, 0.0, 50.0
    )
    t = torch.rand(500, 64, generator=torch.Generator().manual_seed(1)) * 20
    points = origins[:, None] + t[..., None] * directions[:, None]
    inside = hull.contains(points)
    assert inside.any()
    assert not (inside & ~hit[:, None]).any()
    assert not (inside & ((t < near[:, None]) | (t > far[:, None]))).any()


def test_bounds_stay_within_the_callers(hull, rays):
    g = torch.Generator().manual_seed(2)
    near = torch.rand(500, generator=g) * 4
    far = near + torch.rand(500, generator=g) * 4
    for interval in ("first_hit", "entry_exit"):
        bounds = VisDomSampler(hull, epsilon_world=0.4, interval=interval)(*rays, near, far)
        assert (bounds.near >= near).all() and (bounds.far <= far).all()
        assert (bounds.near <= bounds.far).all()
        missed = ~bounds.hit
        assert torch.equal(bounds.near[missed], near[missed]) and torch.equal(bounds.far[missed], far[missed])


@pytest.mark.parametrize("interval", ["first_hit", "entry_exit"])
@pytest.mark.parametrize("missing", ["full", "skip"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.float64])
def test_a_far_in_front_of_near_leaves_nothing_to_sample(hull, rays, interval, missing, dtype):
    """As box intersections give for rays that miss the box; other rays do not notice."""
    g = torch.Generator().manual_seed(4)
    near, far = (10 * torch.rand(500, generator=g, dtype=torch.float64).to(dtype) for _ in range(2))
    origins, directions = (x.to(dtype) for x in rays)
    sampler = VisDomSampler(hull, interval=interval, missing=missing)
    got = sampler(origins, directions, near, far)
    crossed = far < near
    assert (got.near <= got.far).all() and 0.3 < crossed.float().mean() < 0.7
    assert torch.equal(got.near[crossed], near[crossed]) and torch.equal(got.far[crossed], near[crossed])
    assert not got.hit[crossed].any() and got.hit.any()
    alone = sampler(*(x[~crossed] for x in (origins, directions, near, far)))
    assert all(torch.equal(a[~crossed], b) for a, b in zip(got, alone, strict=True))


def test_bounds_do_not_depend_on_the_length_of_directions(hull, rays):
    origins, directions = rays
    sampler = VisDomSampler(hull, epsilon_hull_radii=0.5)
    one, two = sampler(origins, directions, 0.0, 40.0), sampler(origins, 2 * directions, 0.0, 20.0)
    torch.testing.assert_close(one.near, 2 * two.near, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(one.far, 2 * two.far, rtol=1e-4, atol=1e-4)


def test_it_is_pure_without_gradient_and_takes_any_shape_and_dtype(hull, rays):
    origins, directions = (x[:480].reshape(4, 120, 3) for x in rays)
    sampler = VisDomSampler(hull)
    before = hull.occupancy.copy()
    flat = sampler(origins.reshape(-1, 3), directions.reshape(-1, 3), 0.0, 30.0)
    shaped = sampler(origins, directions.clone().requires_grad_(), 0.0, torch.tensor(30.0))
    for a, b in zip(flat, shaped, strict=True):
        assert b.shape == (4, 120) and not b.requires_grad
        assert torch.equal(a.reshape(4, 120), b)
    double = sampler(origins.double(), directions.double(), 0.0, 30.0)
    assert double.near.dtype == torch.float64
    torch.testing.assert_close(double.near.float(), shaped.near, rtol=1e-4, atol=1e-4)
    assert np.array_equal(before, hull.occupancy)
    for other in (copy.deepcopy(sampler), pickle.loads(pickle.dumps(sampler))):
        assert torch.equal(other(origins, directions, 0.0, 30.0).far, shaped.far)


def test_the_unit_of_epsilon_is_what_its_name_says(hull):
    assert VisDomSampler(hull, epsilon_world=0.3).epsilon_world == 0.3
    radii = VisDomSampler(hull, epsilon_hull_radii=0.5)
    assert radii.epsilon_world == pytest.approx(0.5 * hull.radius)
    cameras = ring(5, distance=4.0)
    views = Views(cameras, [None] * 5, [None] * 5, list("abcde"))
    mean = (cameras.centres.numpy() - hull.centre) ** 2
    expected = 0.2 * np.sqrt(mean.sum(-1)).mean()
    assert SamplerConfig(epsilon_camera_distances=0.2).build(hull, views).epsilon_world == pytest.approx(
        expected
    )
    assert SamplerConfig(epsilon_world=0.7).build(hull, views).epsilon_world == 0.7
    assert SamplerConfig(epsilon_hull_radii=2.0).build(hull, views).epsilon_world == pytest.approx(
        2 * hull.radius
    )
    centres = cameras.centres
    spread = max(float((c - centres.mean(0)).norm()) for c in centres)
    assert SamplerConfig(epsilon_capture_radii=0.2).build(hull, views).epsilon_world == pytest.approx(
        0.2 * spread
    )
    with pytest.raises(ConfigError, match="needs the training cameras"):
        VisDomSampler(hull, epsilon_capture_radii=0.2)


def test_the_band_may_reach_less_far_in_front(hull, rays):
    origins, directions = rays
    whole, half = (VisDomSampler(hull, epsilon_world=0.3, front_share=share) for share in (1.0, 0.5))
    a, b = (sampler.bound(origins, directions, 0.0, 50.0) for sampler in (whole, half))
    assert torch.equal(a.hit, b.hit) and a.hit.any() and torch.equal(a.far, b.far)
    first = cast(hull, origins, directions).t_first[a.hit]
    length = directions[a.hit].norm(dim=-1)
    torch.testing.assert_close(a.near[a.hit], first - 0.3 / length)
    torch.testing.assert_close(b.near[a.hit], first - 0.15 / length)


def test_there_is_one_set_of_defaults(hull):
    """The methods' hook, the three lines, and a config with changes are the same settings."""
    cameras = ring(5, distance=4.0)
    views = Views(cameras, [None] * 5, [None] * 5, list("abcde"))
    built, direct = SamplerConfig(enabled=True).build(hull, views), VisDomSampler(hull, cameras=cameras)
    assert direct.epsilon_world == built.epsilon_world
    assert direct.config == SamplerSettings() == VisDomSampler(hull).config
    assert VisDomSampler(hull).epsilon_world == pytest.approx(0.1 * hull.radius)
    given = VisDomSampler(hull, SamplerConfig(missing="skip"), interval="first_hit", cameras=cameras)
    assert given.config == SamplerConfig(missing="skip", interval="first_hit")
    with pytest.raises(TypeError, match="mising"):
        VisDomSampler(hull, mising="skip")


def test_only_hooks_that_say_so_filter_samples(hull):
    class BoundsOnly:
        def bound(self, origins, directions, near, far): ...

    silent, speaking = VisDomSampler(hull), VisDomSampler(hull, drop_outside=True)
    assert isinstance(silent, SampleFilter) and not isinstance(BoundsOnly(), SampleFilter)
    assert sample_filters([silent, speaking, BoundsOnly()]) == [speaking]


@pytest.mark.parametrize(
    "settings",
    [
        {"epsilon_world": -1.0},
        {"epsilon_world": float("nan")},
        {"epsilon_world": 0.0, "interval": "first_hit"},
        {"epsilon_world": 0.1, "epsilon_hull_radii": 0.1},
        {"epsilon_world": 0.1, "epsilon_capture_radii": 0.1},
        {"front_share": -0.1},
        {"epsilon_camera_distances": -0.1},
        {"interval": "exit"},
        {"missing": "drop"},
    ],
)
def test_wrong_settings_are_named(hull, settings):
    with pytest.raises(ConfigError) as error:
        VisDomSampler(hull, **settings)
    assert next(iter(settings)).split("_")[0] in str(error.value)
