"""Losses by their definitions."""

import itertools
import math
from functools import partial

import pytest
import torch

from visdom_plugin import losses
from visdom_plugin.hooks.regularizer import outside_loss
from visdom_plugin.losses import below_one, composite_target, disparity_loss, mask_loss, photometric_loss
from visdom_plugin.nerf.rendering.volume import weights_from_density
from visdom_plugin.ssim import ssim


def images(seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.rand(24, 20, 3, generator=g), torch.rand(24, 20, 3, generator=g)


def test_photometric_loss_mixes_l1_and_ssim():
    x, y = images()
    expected = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim(x, y))
    torch.testing.assert_close(photometric_loss(x, y, 0.2), expected)
    assert photometric_loss(x, x, 0.2).abs() < 1e-6


def test_mask_loss_is_cross_entropy_and_finite_at_the_ends():
    alpha = torch.tensor([[0.2, 0.9], [0.0, 1.0]], requires_grad=True)
    mask = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    expected = -(torch.log(torch.tensor(0.8)) + torch.log(torch.tensor(0.9))) / 4
    torch.testing.assert_close(mask_loss(alpha[:1], mask[:1]), 2 * expected)
    mask_loss(alpha, mask).backward()
    assert torch.isfinite(alpha.grad).all()


def test_opacity_below_one_is_the_bound_in_value_and_the_identity_in_gradient():
    near_one = 1 - torch.logspace(-8, -4, 200, dtype=torch.float64)
    for dtype in (torch.float32, torch.float64):
        alpha = torch.cat([torch.linspace(0, 1.0001, 500).double(), near_one]).to(dtype).requires_grad_()
        bounded = below_one(alpha)
        assert torch.equal(bounded, alpha.clamp_max(1 - 1e-6)) and (alpha > 1 - 1e-6).sum() > 20
        bounded.sum().backward()
        assert (alpha.grad == 1).all()


def mask_loss_by_autograd(alpha, mask, weight, clamp):
    """Slow twin."""
    if clamp > 1e-6:
        alpha, mask = (x.clamp(clamp, 1 - clamp) for x in (alpha, mask))
    alpha = torch.where(mask < 1, below_one(alpha), alpha.clamp_max(1 - 1e-6)).clamp_min(1e-6)
    weight = torch.ones_like(alpha) if weight is None else weight
    entropy = -(mask * alpha.log() + (1 - mask) * (1 - alpha).log())
    return (weight * entropy).sum() / weight.sum().clamp_min(1)


@pytest.mark.parametrize("clamp", [1e-6, 0.01])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_mask_loss_equals_its_twin(clamp, weighted, dtype):
    near_one = 1 - torch.logspace(-8, -4, 200, dtype=torch.float64)
    near_zero = torch.cat([torch.logspace(-8, -2, 200, dtype=torch.float64), torch.zeros(1).double()])
    alpha = torch.cat([torch.linspace(0, 1.0001, 500).double(), near_one, near_zero]).to(dtype)
    assert (alpha > 1 - 1e-6).sum() > 20
    draw = torch.Generator().manual_seed(0)
    weight = (torch.rand(len(alpha), generator=draw) > 0.3).to(dtype) if weighted else None
    for mask in (torch.zeros(()), torch.ones(()), torch.tensor(0.3)):
        results = []
        for loss in (mask_loss, mask_loss_by_autograd):
            at = alpha.clone().requires_grad_()
            value = 3 * loss(at, mask.to(dtype).expand_as(at), weight, clamp)
            results.append((value.detach(), *torch.autograd.grad(value, at)))
        torch.testing.assert_close(*results, rtol=1e-5, atol=1e-7)


def both_losses(alpha):
    """Of pixels off the object and off the hull."""
    return [mask_loss(alpha, torch.zeros_like(alpha)), outside_loss(alpha, torch.zeros_like(alpha).bool())]


def test_the_pull_on_a_pixel_grows_with_its_opacity_up_to_one():
    for which in (0, 1):
        alpha = torch.tensor([0.5, 0.9999, 0.999999, 0.9999995, 1.0, 1.0000001], requires_grad=True)
        both_losses(alpha)[which].backward()
        assert (alpha.grad.diff() >= 0).all() and (alpha.grad > 0).all() and torch.isfinite(alpha.grad).all()
        assert alpha.grad[-1] == pytest.approx(1e6 / 6, rel=0.02)


@pytest.mark.parametrize("depth", [5.0, 13.0, 14.0, 20.0])
def test_a_saturated_ray_still_loses_density(depth):
    """The opacity of a ray of optical depth 20 is 1 in float32; its density has a gradient nevertheless."""
    for which in (0, 1):
        density = torch.full((1, 8), depth, requires_grad=True)
        weights, _ = weights_from_density(density, torch.linspace(0, 1, 9)[None])
        both_losses(weights.sum(-1))[which].backward()
        assert (density.grad > 0).all()


def test_inside_the_mask_the_gradient_ends_at_the_bounds():
    alpha = torch.tensor([0.0, 1e-7, 0.5, 1.0], requires_grad=True)
    mask_loss(alpha, torch.ones(4)).backward()
    assert alpha.grad.tolist() == [0, 0, -0.5, 0]


def test_a_wider_clamp_asks_for_less_and_stops_pulling_there():
    alpha = torch.tensor([0.0005, 0.3, 0.9, 0.9999], requires_grad=True)
    mask = torch.tensor([0.0, 0.0, 1.0, 1.0])
    loss = mask_loss(alpha, mask, clamp=0.001)
    expected = 0.0
    for a, m in zip(alpha.tolist(), mask.tolist(), strict=True):
        a, m = (min(max(x, 0.001), 0.999) for x in (a, m))
        expected -= m * math.log(a) + (1 - m) * math.log(1 - a)
    assert loss.item() == pytest.approx(expected / 4, rel=1e-5)
    loss.backward()
    assert alpha.grad[0] == alpha.grad[3] == 0 and alpha.grad[1] > 0 > alpha.grad[2]


def test_disparity_loss_ignores_scale_and_shift_of_disparity():
    g = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(16, 16, generator=g)
    ones = torch.ones(16, 16)
    mono = 1 / (0.3 / depth + 0.1)
    assert disparity_loss(depth, ones, mono, ones) < 1e-5
    assert disparity_loss(depth, ones, 1 + torch.rand(16, 16, generator=g), ones) > 0.1


def test_disparity_loss_needs_ten_pixels():
    ones = torch.ones(16, 16)
    mask = torch.zeros(16, 16)
    mask[0, :9] = 1
    assert disparity_loss(ones, ones, ones, mask) is None


def test_ignored_pixels_take_no_part():
    """Neither what is photographed nor what is rendered there changes the loss or the gradient elsewhere."""
    x, y = images()
    draw = torch.Generator().manual_seed(3)
    weight = (torch.rand(24, 20, generator=draw) > 0.3).float()
    alpha, mask = torch.rand(24, 20, generator=draw), (torch.rand(24, 20, generator=draw) > 0.5).float()
    hidden = weight[..., None] == 0
    results = []
    for other in (0.0, 0.7):
        rgb = torch.where(hidden, other, x).requires_grad_()
        opacity = torch.where(weight == 0, other, alpha).requires_grad_()
        loss = photometric_loss(rgb, torch.where(hidden, 1 - other, y), 0.2, weight)
        loss = loss + mask_loss(opacity, torch.where(weight == 0, 1.0, mask), weight)
        loss.backward()
        assert (rgb.grad[hidden.expand_as(rgb)] == 0).all() and (opacity.grad[weight == 0] == 0).all()
        assert (rgb.grad != 0).any() and (opacity.grad != 0).any()
        results.append((loss.detach(), rgb.grad, opacity.grad))
    assert all(map(torch.equal, *results))


def test_weights_of_one_change_nothing_and_means_are_over_what_counts():
    x, y = images()
    mask = (y[..., 0] > 0.5).float()
    ones = torch.ones(24, 20)
    torch.testing.assert_close(photometric_loss(x, y, 0.2, ones), photometric_loss(x, y, 0.2))
    torch.testing.assert_close(mask_loss(x[..., 1], mask, ones), mask_loss(x[..., 1], mask))
    left = torch.zeros(24, 20)
    left[:, :9] = 1
    torch.testing.assert_close(photometric_loss(x, y, 0, left), photometric_loss(x[:, :9], y[:, :9], 0))
    torch.testing.assert_close(mask_loss(x[..., 1], mask, left), mask_loss(x[:, :9, 1], mask[:, :9]))
    nothing = torch.zeros(24, 20)
    assert photometric_loss(x, y, 0.2, nothing).abs() < 1e-3 and mask_loss(x[..., 1], mask, nothing) == 0


def test_an_unknown_mask_asks_for_colour_and_for_no_opacity():
    """Where opacity a paints the photograph's colour on the background, the target is met for every a."""
    image, background = images()[0], torch.tensor([0.2, 0.5, 0.9])
    mask = torch.ones(24, 20)
    for a in (0.0, 0.4, 1.0):
        alpha = torch.full((24, 20), a)
        render = image * a + background * (1 - a)
        torch.testing.assert_close(
            composite_target(image, mask, background, alpha=alpha, mask_known=False), render
        )
    known = torch.rand(24, 20) > 0.5
    mixed = composite_target(image, mask, background, alpha=torch.zeros(24, 20), mask_known=known)
    assert torch.equal(mixed[known], image[known]) and (mixed[~known] == background).all()
    assert torch.equal(
        composite_target(image, mask, background), composite_target(image, mask, background, mask_known=True)
    )


def opacities(n, dtype):
    """Of all sizes, those near 0 and 1 among them."""
    draw = torch.Generator().manual_seed(n)
    spread = torch.rand(n, generator=draw, dtype=torch.float64) ** 4
    alpha = torch.where(torch.rand(n, generator=draw) < 0.5, spread, 1 - 1e-3 * spread)
    alpha[: min(n, 3)] = torch.tensor([0.0, 1.0, 1e-9]).double()[: min(n, 3)]
    return alpha.to(dtype)


# Fewer than a vector has, the last vector beginning in the block before, several pieces.
@pytest.mark.parametrize("n", [5, 16, 1027, 9001])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernels_of_losses_are_torchs_with_the_same_gradients_to_the_bit(n, dtype, monkeypatch):
    alpha, draw = opacities(n, dtype), torch.Generator().manual_seed(n + 1)
    mask = (torch.rand(n, generator=draw) < 0.5).to(dtype)
    soft = torch.where(torch.rand(n, generator=draw) < 0.3, mask / 2, mask)
    weight = (torch.rand(n, generator=draw) < 0.7).to(dtype)
    settings = itertools.product((mask, soft), (None, weight), (1e-6, 0.1))
    calls = [partial(mask_loss, mask=m, weight=w, clamp=c) for m, w, c in settings]
    calls.append(partial(outside_loss, hull_mask=mask.bool()))
    before = torch.get_num_threads()
    for call in calls:
        found = []
        for threads in (1, 3, 0):
            with monkeypatch.context() as patch:
                torch.set_num_threads(threads or 1)
                if not threads:
                    patch.setattr(losses, "fills_vectors", lambda alpha: False)
                at = alpha.clone().requires_grad_()
                value = 0.7 * call(at)
                found.append((value.detach(), *torch.autograd.grad(value, at)))
            torch.set_num_threads(before)
        one, three, twin = found
        assert torch.equal(one[0], three[0]) and torch.equal(one[1], three[1])
        assert torch.equal(one[1], twin[1]) and (n < 16 or one[1].any())
        torch.testing.assert_close(one[0], twin[0], rtol=2e-6 if dtype == torch.float32 else 1e-13, atol=0)


def test_losses_of_opacities_of_which_one_is_not_a_number_are_none():
    alpha = opacities(2000, torch.float32)
    alpha[1500] = torch.nan
    for value in both_losses(alpha):
        assert value.isnan()


def test_very_small_opacities_beside_the_hull_count():
    alpha = torch.full((40,), 3e-9)
    outside = outside_loss(alpha, torch.zeros(40).bool())
    torch.testing.assert_close(outside, torch.tensor(3e-9), rtol=1e-6, atol=0)
