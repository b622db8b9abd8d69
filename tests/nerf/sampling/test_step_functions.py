"""Step functions: samples follow the histogram, nothing leaves its domain, blurring keeps the mass."""

import pytest
import torch

from visdom_plugin.nerf.sampling import ray_warp
from visdom_plugin.nerf.sampling import step_functions as steps

SAMPLERS = {
    "kernel": steps.sample_edges,
    "torch": lambda t, w, n, jitter: steps._sample_torch(t, w, n, jitter),
}


def _histograms(rays: int, count: int, seed: int = 0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(rays, count + 1, generator=generator, dtype=dtype).sort(-1).values
    weights = torch.randn(rays, count, generator=generator, dtype=dtype).mul(2).exp()
    return edges, weights / weights.sum(-1, keepdim=True)


def _mass_below(edges, weights, at):
    """Slow twin: the share of the mass below each point (rays, N)."""
    width = edges.diff(dim=-1)
    inside = (at[..., None] - edges[:, None, :-1]).clamp_min(0).minimum(width[:, None])
    return (weights[:, None] * inside / width[:, None]).sum(-1)


def _blur(edges, weights, half_width):
    """Slow twin: the density averaged over a window of `half_width` to either side, piecewise linear between the
    sorted knots (rays, 2 S + 2) where the window meets an edge (Zip-NeRF, section 3)."""
    knots = torch.cat([edges - half_width, edges + half_width], -1).sort(-1).values
    mass = torch.nn.functional.pad(weights.cumsum(-1), (1, 0))
    above, below = (steps._interpolate(edges, mass, knots + side) for side in (half_width, -half_width))
    return knots, (above - below) / (2 * half_width)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("single", [True, False])
def test_samples_follow_the_histogram(sampler, single):
    """Kolmogorov's distance between the new edges and the histogram is at most one part in their number."""
    edges, weights = _histograms(30, 12)
    for count in (2, 7, 500):
        jitter = torch.rand(30, 1 if single else count, dtype=torch.float64)
        new = SAMPLERS[sampler](edges, weights, count, jitter)
        expected = torch.arange(count + 1, dtype=torch.float64) / count
        distance = (_mass_below(edges, weights, new) - expected).abs().amax()
        assert new.shape == (30, count + 1)
        assert distance <= 1 / count + 1e-9


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_jitter_makes_every_point_as_likely_as_its_mass(sampler):
    """Over many jitters the middle edge of two is spread such that each point's share is exact."""
    edges = torch.tensor([[0.0, 0.2, 0.9, 1.0]], dtype=torch.float64)
    weights = torch.tensor([[0.1, 0.2, 0.7]], dtype=torch.float64)
    trials, count = 4000, 64
    jitter = (torch.arange(trials, dtype=torch.float64)[:, None] + 0.5) / trials
    new = SAMPLERS[sampler](edges.expand(trials, -1), weights.expand(trials, -1), count, jitter)
    inside = new[:, 1:-1]
    for low, high, share in ((0.0, 0.2, 0.1), (0.2, 0.9, 0.2), (0.9, 1.0, 0.7)):
        found = ((inside >= low) & (inside < high)).sum() / (trials * count)
        assert abs(float(found) - share) < 1 / count


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_new_edges_ascend_inside_the_old_ones(sampler):
    edges, weights = _histograms(200, 16, dtype=torch.float32)
    weights[::3] = 0  # meets nothing
    weights[1::3, 5:] = 0
    edges[2::3, 4:8] = edges[2::3, 4:5]  # intervals of no length
    new = SAMPLERS[sampler](edges, weights, 33, torch.rand(200, 33))
    assert (new.diff(dim=-1) >= 0).all()
    assert (new[:, 0] >= edges[:, 0]).all() and (new[:, -1] <= edges[:, -1]).all()


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_ray_that_meets_nothing_keeps_its_intervals(sampler):
    edges = torch.linspace(0, 1, 9).double()[None]
    half = torch.full((1,), 0.5).double()
    torch.testing.assert_close(SAMPLERS[sampler](edges, torch.zeros(1, 8).double(), 8, half), edges)


def test_sampling_its_own_edges_is_the_identity():
    edges = torch.linspace(2, 5, 17).double().expand(3, -1)
    new = steps.sample_edges(edges, torch.full((3, 16), 0.1).double(), 16)
    torch.testing.assert_close(new, edges)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_sampling_moves_with_shift_and_scale(sampler):
    edges, weights = _histograms(20, 10)
    jitter = torch.rand(20, 1).double()
    new = SAMPLERS[sampler](edges, weights, 25, jitter)
    moved = SAMPLERS[sampler](3 * edges - 7, 0.01 * weights, 25, jitter)
    torch.testing.assert_close(moved, 3 * new - 7)


def test_one_interval_with_all_the_mass_gets_all_samples():
    edges, weights = _histograms(20, 10)
    weights[:, :6] = 0
    weights[:, 7:] = 0
    new = steps.sample_edges(edges, weights, 12)
    torch.testing.assert_close(new[:, 0], edges[:, 6], atol=1e-8, rtol=0)
    torch.testing.assert_close(new[:, -1], edges[:, 7], atol=1e-8, rtol=0)


def test_kernels_equal_torch():
    edges, weights = _histograms(60, 14)
    weights[::7] = 0
    edges[1::5, 3] = edges[1::5, 4]
    edges[2::5, 0] = edges[2::5, 1]
    edges[3::5, 14] = edges[3::5, 13]
    jitter = torch.rand(60, 20).double()
    pairs = [
        (steps.sample_edges(edges, weights, 20, jitter), steps._sample_torch(edges, weights, 20, jitter)),
    ]
    at = torch.rand(60, 31).double().mul(1.6).sub(0.3).sort(-1).values
    for half_width in (0.003, 0.3, 2.0):
        slow = steps._resample_blurred_torch(edges, weights, half_width, at)
        pairs.append((steps.resample_blurred(edges, weights, half_width, at), slow))
    for fast, slow in pairs:
        torch.testing.assert_close(fast, slow, rtol=1e-8, atol=1e-10)


def test_leading_dimensions_broadcast():
    _, weights = _histograms(6, 4)
    edges = torch.linspace(0, 1, 5).double()
    new = steps.sample_edges(edges, weights.reshape(2, 3, 4), 5)
    torch.testing.assert_close(new.reshape(6, 6), steps.sample_edges(edges.expand(6, -1), weights, 5))


def test_annealing_goes_from_flat_to_the_weights():
    _, weights = _histograms(5, 8)
    assert torch.equal(steps.anneal(weights, 0.0), torch.ones_like(weights))
    assert torch.equal(steps.anneal(weights, 1.0), weights)
    half = steps.anneal(weights, 0.5)
    torch.testing.assert_close(half, weights ** (5 / 5.5))


@pytest.mark.parametrize("half_width", [0.003, 0.03, 0.5])
def test_blurring_keeps_the_mass_and_averages(half_width):
    edges, weights = _histograms(10, 6)
    knots, density = _blur(edges, weights, half_width)
    width = knots.diff(dim=-1)
    torch.testing.assert_close((0.5 * (density[:, 1:] + density[:, :-1]) * width).sum(-1), weights.sum(-1))
    assert (density >= -1e-9).all()
    torch.testing.assert_close(density[:, [0, -1]], torch.zeros(10, 2).double(), atol=1e-8, rtol=0)
    window = _mass_below(edges, weights, knots + half_width) - _mass_below(edges, weights, knots - half_width)
    torch.testing.assert_close(density, window / (2 * half_width), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("half_width", [0.003, 0.2])
def test_resampled_mass_is_the_blurred_functions_integral(half_width):
    edges, weights = _histograms(10, 6)
    knots, density = _blur(edges, weights, half_width)
    # The trapezoid rule is exact between knots, so the points asked for go among them.
    at = torch.rand(10, 9).double().mul(1.8).sub(0.4).sort(-1).values
    everything = torch.cat([knots, at], -1).sort(-1).values
    values = steps._interpolate(knots, density, everything)
    running = torch.nn.functional.pad(
        (0.5 * (values[:, 1:] + values[:, :-1]) * everything.diff(dim=-1)).cumsum(-1), (1, 0)
    )
    below = running.gather(-1, torch.searchsorted(everything, at))
    mass = steps.resample_blurred(edges, weights, half_width, at)
    torch.testing.assert_close(mass, below.diff(dim=-1), rtol=1e-8, atol=1e-10)
    whole = steps.resample_blurred(edges, weights, half_width, torch.tensor([[-1.0, 0.1, 0.8, 2.0]]).double())
    torch.testing.assert_close(whole.sum(-1), weights.sum(-1))


def _sample_distances_slowly(edges, weights, count, near, far, exponent, power, jitter):
    new = steps._sample_torch(edges, weights**exponent, count, jitter)
    return new, ray_warp.distances_of(new, near[..., None], far[..., None], power)


@pytest.mark.parametrize("exponent", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("power", [-1.5, 0.5, 1.0])
def test_sampled_distances_equal_torch(exponent, power):
    edges, weights = _histograms(60, 14)
    edges = (edges - edges[:, :1]) / (edges[:, -1:] - edges[:, :1])
    weights[::7] = 0
    jitter = torch.rand(60, 1).double()
    near, far = torch.rand(60).double(), 2 + torch.rand(60).double()
    far[::5], far[1::5] = 1e6, near[1::5]  # all of space, and nothing
    slow = _sample_distances_slowly(edges, weights, 20, near, far, exponent, power, jitter)
    named = {"exponent": exponent, "power": power}
    fast = steps.sample_distances(edges, weights, 20, near, far, jitter=jitter, **named)
    torch.testing.assert_close(fast, slow, rtol=1e-7, atol=1e-9)
    singles = [x.float() for x in (edges, weights, near, far, jitter)]
    s, t = steps.sample_distances(*singles[:2], 20, *singles[2:4], jitter=singles[4], **named)
    torch.testing.assert_close(s.double(), slow[0], rtol=0, atol=2e-6)
    expected = ray_warp.distances_of(s.double(), near[:, None], far[:, None], power)
    near_the_camera = expected < 100  # where one step of s is less than a step of what is told apart
    torch.testing.assert_close(t.double()[near_the_camera], expected[near_the_camera], rtol=1e-5, atol=1e-6)
    assert (t.diff(dim=-1) >= 0).all() and torch.isfinite(t).all()
    assert (t >= singles[2][:, None]).all() and (t <= singles[3][:, None]).all()


def test_the_first_level_samples_the_whole_interval():
    near, far = torch.tensor([0.1, 2.0, 0.0]), torch.tensor([5.0, 2.5, float("inf")])
    s, t = steps.sample_distances(torch.tensor([0.0, 1.0]), torch.ones(1), 8, near, far)
    torch.testing.assert_close(s, torch.linspace(0, 1, 9).expand(3, -1))
    torch.testing.assert_close((t[:, 0], t[:, -1]), (near, far))


def test_sampling_is_the_same_bit_for_bit_on_one_thread_and_two():
    edges, weights = _histograms(400, 20, dtype=torch.float32)
    near, far, results, before = torch.rand(400), 2 + torch.rand(400), [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(steps.sample_distances(edges, weights, 30, near, far, exponent=0.3))
    finally:
        torch.set_num_threads(before)
    assert all(map(torch.equal, *results))


def test_nothing_carries_a_gradient():
    edges, weights = _histograms(3, 4)
    weights.requires_grad_()
    results = [
        steps.sample_edges(edges, weights, 4),
        steps.resample_blurred(edges, weights, 0.1, edges),
        steps.anneal(weights, 0.5),
        *steps.sample_distances(edges, weights, 4, edges[:, 0], edges[:, -1]),
    ]
    assert not any(x.requires_grad for x in results)


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match="at least 2"):
        steps.sample_edges(*_histograms(1, 3), 1)
