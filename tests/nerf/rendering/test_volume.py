"""Volume rendering: conservation, extreme densities, and ragged samples against dense ones."""

import pytest
import torch

from visdom_plugin.nerf.rendering import volume
from visdom_plugin.nerf.rendering.volume import composite, weights_from_density
from visdom_plugin.nerf.rendering.volume_packed import _composite_torch, composite_packed, offsets_of

PACKED = [composite_packed, _composite_torch]


def _rays(rays: int, samples: int, seed: int = 0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    distances = 1 + torch.rand(rays, samples + 1, generator=generator, dtype=dtype).cumsum(-1)
    density = torch.randn(rays, samples, generator=generator, dtype=dtype).exp()
    rgb = torch.rand(rays, samples, 3, generator=generator, dtype=dtype)
    return density, rgb, distances, torch.rand(rays, 3, generator=generator, dtype=dtype)


def _flatten(density, rgb, distances, background):
    rays, samples = density.shape
    offsets = torch.arange(rays + 1) * samples
    starts, ends = distances[:, :-1].reshape(-1), distances[:, 1:].reshape(-1)
    return density.reshape(-1), rgb.reshape(-1, 3), starts, ends, offsets, background


def test_weights_sum_to_what_does_not_pass():
    density, _, distances, _ = _rays(50, 12)
    weights, transmittance = weights_from_density(density, distances)
    passed = torch.exp(-(density * distances.diff()).sum(-1))
    torch.testing.assert_close(weights.sum(-1), 1 - passed)
    torch.testing.assert_close(transmittance[:, 0], torch.ones(50).double())
    torch.testing.assert_close(transmittance - weights, torch.cat([transmittance[:, 1:], passed[:, None]], 1))


def test_splitting_intervals_changes_neither_colour_nor_alpha():
    density, rgb, distances, background = _rays(20, 9)
    rgb_whole, alpha, _ = composite(weights_from_density(density, distances)[0], rgb, distances, background)
    finer = torch.cat([distances, 0.3 * distances[:, 1:] + 0.7 * distances[:, :-1]], 1).sort(1).values
    density, rgb = density.repeat_interleave(2, 1), rgb.repeat_interleave(2, 1)
    rgb_split, alpha_split, _ = composite(weights_from_density(density, finer)[0], rgb, finer, background)
    torch.testing.assert_close(rgb_split, rgb_whole)
    torch.testing.assert_close(alpha_split, alpha)


def test_nothing_and_a_wall():
    density, rgb, distances, background = _rays(4, 6, dtype=torch.float32)
    colour, alpha, depth = composite(torch.zeros(4, 6), rgb, distances, background)
    torch.testing.assert_close((colour, alpha, depth), (background, torch.zeros(4), distances[:, -1]))
    density = torch.zeros_like(density)
    density[:, 2] = 1e20
    colour, alpha, depth = composite(weights_from_density(density, distances)[0], rgb, distances, background)
    torch.testing.assert_close((colour, alpha), (rgb[:, 2], torch.ones(4)))
    torch.testing.assert_close(depth, 0.5 * (distances[:, 2] + distances[:, 3]), rtol=1e-5, atol=0)


@pytest.mark.parametrize("value", [1e10, 1e38, float("inf")])
@pytest.mark.parametrize("packed", [None, *PACKED])
def test_extreme_densities_give_numbers(value, packed):
    _, rgb, distances, background = _rays(3, 5, dtype=torch.float32)
    distances[:, 2] = distances[:, 1]  # an interval of no length
    density = torch.full((3, 5), value, requires_grad=True)
    if packed is None:
        weights, _ = weights_from_density(density, distances)
        out = composite(weights, rgb, distances, background)
    else:
        *out, weights = packed(*_flatten(density.clamp_max(1e30), rgb, distances, background))
    assert torch.equal(weights.detach().reshape(3, 5)[:, 0], torch.ones(3))
    (slope,) = torch.autograd.grad(sum(x.sum() for x in out), density)
    assert all(torch.isfinite(x).all() for x in (*out, slope))


@pytest.mark.parametrize("packed", PACKED)
def test_packed_equals_dense(packed):
    """Rays of 0 to 9 samples against dense rays whose missing samples are empty space."""
    density, rgb, distances, background = (x.requires_grad_() for x in _rays(40, 9))
    distances = distances.detach()
    length = torch.arange(40) % 10
    kept = torch.arange(9) < length[:, None]
    weights, _ = weights_from_density(density * kept, distances)
    dense = composite(weights, rgb, distances, background)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), length.cumsum(0)])
    samples = density[kept], rgb[kept], distances[:, :-1][kept], distances[:, 1:][kept]
    *out, packed_weights = packed(*samples, offsets, background)
    torch.testing.assert_close(packed_weights, weights[kept].detach())
    assert not packed_weights.requires_grad
    torch.testing.assert_close(out[:2], list(dense[:2]))
    # Both depths lean to their own last edge by alpha's 1e-6.
    some = length > 0
    torch.testing.assert_close(out[2][some], dense[2][some], rtol=1e-4, atol=0)
    assert torch.equal(out[2][~some].detach(), torch.zeros(4).double())
    slopes = [torch.randn_like(x) for x in dense[:2]]
    by = (density, rgb, background)
    expected = torch.autograd.grad(dense[:2], by, slopes)
    torch.testing.assert_close(torch.autograd.grad(out[:2], by, slopes), expected)


@pytest.mark.parametrize("packed", PACKED)
def test_packed_gradients_equal_finite_differences(packed):
    density, rgb, starts, ends, offsets, background = _flatten(*_rays(3, 4))
    offsets = torch.tensor([0, 5, 5, 12])

    def render(density, rgb, background):
        return packed(density, rgb, starts, ends, offsets, background)[:3]

    inputs = [x.clone().requires_grad_() for x in (density, rgb, background)]
    assert torch.autograd.gradcheck(render, inputs)


def test_dense_gradients_equal_finite_differences():
    density, rgb, distances, background = _rays(3, 4)

    def render(density, rgb, background):
        return composite(weights_from_density(density, distances)[0], rgb, distances, background)

    assert torch.autograd.gradcheck(render, [x.requires_grad_() for x in (density, rgb, background)])


def _dense(density, rgb, distances, background, weigh, compose):
    """All that dense rays give, then gradients by everything but distances for random slopes of the results."""
    inputs = [x.clone().requires_grad_() for x in (density, rgb, background)]
    weights, transmittance = weigh(inputs[0], distances)
    out = (*compose(weights, inputs[1], distances, inputs[2]), weights, transmittance)
    draw = torch.Generator().manual_seed(1)
    total = sum((x * torch.rand(x.shape, generator=draw).to(x)).sum() for x in out)
    return [x.detach() for x in out] + list(torch.autograd.grad(total, inputs))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dense_kernels_equal_torch(dtype):
    """With leading dimensions, one background and one set of edges for several rays, densities of 0 and beyond all
    bounds, and intervals of no length."""
    density, rgb, distances, background = _rays(12, 7)
    density[::3, 2], density[1::3, 4], density[2::3, :] = 0, float("inf"), 0
    distances[:, 5] = distances[:, 4]
    cases = [(density.reshape(3, 4, 7), rgb.reshape(3, 4, 7, 3), distances.reshape(3, 4, 8), background[0])]
    cases.append((density, rgb, distances[0], background))
    for case in cases:
        slow = _dense(*case, volume._weights_torch, volume._composite_torch)
        fast = _dense(*(x.to(dtype) for x in case), weights_from_density, composite)
        tolerance = {"rtol": 1e-9, "atol": 1e-12} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 2e-6}
        for a, b in zip(fast, slow, strict=True):
            assert a.dtype == dtype
            torch.testing.assert_close(a.double(), b, **tolerance)


def test_gradients_by_the_distances_are_torchs():
    density, _, distances, _ = _rays(3, 4)
    assert torch.autograd.gradcheck(lambda t: weights_from_density(density, t), [distances.requires_grad_()])


@pytest.mark.parametrize("rays,samples", [(0, 5), (3, 0)])
def test_dense_rays_without_samples_and_no_rays(rays, samples):
    density, rgb, distances, background = _rays(rays, samples, dtype=torch.float32)
    weights, transmittance = weights_from_density(density, distances)
    colour, alpha, depth = composite(weights, rgb, distances, background)
    assert weights.shape == transmittance.shape == (rays, samples)
    torch.testing.assert_close((colour, alpha, depth), (background, torch.zeros(rays), distances[:, -1]))


def test_dense_is_the_same_bit_for_bit_on_one_thread_and_two():
    case = _rays(400, 20, dtype=torch.float32)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(_dense(*case, weights_from_density, composite))
    finally:
        torch.set_num_threads(before)
    assert all(map(torch.equal, *results))


@pytest.mark.parametrize("packed", PACKED)
@pytest.mark.parametrize("rays", [1, 500])
def test_packed_float32_keeps_its_precision_over_50_000_samples(packed, rays):
    """A running sum in float32 over all rays would be off by 1e-3."""
    density, rgb, distances, background = _rays(rays, 50_000 // rays)
    density *= 3 * rays / 50_000
    exact = composite(weights_from_density(density, distances)[0], rgb, distances, background)
    singles = [x.float() for x in (density, rgb, distances - distances[:, :1], background)]
    out = packed(*_flatten(*singles))
    torch.testing.assert_close(out[0].double(), exact[0], rtol=0, atol=2e-6)
    torch.testing.assert_close(out[1].double(), exact[1], rtol=0, atol=2e-6)


def test_packed_is_the_same_bit_for_bit_on_one_thread_and_two():
    flat = _flatten(*_rays(400, 20, dtype=torch.float32))
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            density, rgb = (x.clone().requires_grad_() for x in flat[:2])
            *out, weights = composite_packed(density, rgb, *flat[2:])
            results.append((*out, weights, *torch.autograd.grad(sum(x.sum() for x in out), (density, rgb))))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("packed", PACKED)
def test_packed_without_any_sample_shows_the_background(packed):
    background = torch.rand(3, 3)
    none = torch.zeros(0)
    colour, alpha, depth, weights = packed(
        none, torch.zeros(0, 3), none, none, torch.zeros(4, dtype=torch.int64), background
    )
    torch.testing.assert_close((colour, alpha, depth), (background, torch.zeros(3), torch.zeros(3)))
    assert weights.shape == (0,)


def test_offsets_of_sorted_ray_numbers():
    ray = torch.tensor([0, 0, 2, 2, 2, 5])
    assert offsets_of(ray, 7).tolist() == [0, 2, 2, 5, 5, 5, 6, 6]
