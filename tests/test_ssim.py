"""SSIM against plain definitions, in value and gradient."""

import pytest
import torch

from visdom_plugin import ssim as module
from visdom_plugin.ssim import ssim

SIZES = [(3, 1, 3), (1, 30, 1), (11, 11, 3), (24, 37, 3), (2, 19, 23, 4)]


def images(*shape, dtype=torch.float64, noise=0.2):
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(*shape, generator=generator, dtype=torch.float64)
    y = (x + noise * torch.randn(*shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return x.to(dtype).requires_grad_(), y.to(dtype)


def slow_ssim(x, y):
    """The definition, one window at a time, outside the image counted as zero."""
    offsets = torch.arange(-5, 6).double()
    window = torch.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    pad = (0, 0, 5, 5, 5, 5)
    x, y = torch.nn.functional.pad(x, pad), torch.nn.functional.pad(y, pad)
    values = []
    for row in range(x.shape[0] - 10):
        for column in range(x.shape[1] - 10):
            a, b = x[row : row + 11, column : column + 11], y[row : row + 11, column : column + 11]
            mean_a, mean_b = (window * a).sum((0, 1)), (window * b).sum((0, 1))
            variances = (window * a * a).sum((0, 1)) - mean_a**2 + (window * b * b).sum((0, 1)) - mean_b**2
            covariance = (window * a * b).sum((0, 1)) - mean_a * mean_b
            top = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
            values.append(top / ((mean_a**2 + mean_b**2 + 1e-4) * (variances + 9e-4)))
    return torch.stack(values).mean()


@pytest.mark.parametrize("size", SIZES)
def test_equals_the_definition_in_value_and_gradient(size):
    x, y = images(*size)
    value = ssim(x, y)
    (ours,) = torch.autograd.grad(value, x)
    batch = zip(x.reshape(-1, *size[-3:]), y.reshape(-1, *size[-3:]), strict=True)
    expected = torch.stack([slow_ssim(a, b) for a, b in batch]).mean()
    (theirs,) = torch.autograd.grad(expected, x)
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("size", SIZES)
def test_the_path_for_other_devices_agrees(size):
    x, y = images(*size)
    fast, plain = ssim(x, y), module._ssim_by_convolution(x, y)
    torch.testing.assert_close(fast, plain, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(*(torch.autograd.grad(z, x)[0] for z in (fast, plain)), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("size", SIZES)
def test_the_mean_difference_comes_with_it(size):
    x, y = images(*size)
    with torch.no_grad():
        x[..., 0, 0] = y[..., 0, 0]  # equal numbers have the gradient 0
    l1 = module.l1_with_ssim(x, y, 1.0, 0.0)
    torch.testing.assert_close(l1, (x - y).abs().mean(), rtol=1e-12, atol=0)
    (alone,) = torch.autograd.grad(l1, x)
    torch.testing.assert_close(alone, torch.sign(x - y).detach() / x.numel(), rtol=1e-12, atol=0)
    both = module.l1_with_ssim(x, y, 0.8, -0.2, 0.2)
    plain = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim(x, y))
    torch.testing.assert_close(both, plain, rtol=1e-12, atol=1e-15)
    gradients = (torch.autograd.grad(3 * z, x)[0] for z in (both, plain))
    torch.testing.assert_close(*gradients, rtol=1e-10, atol=1e-15)


def test_float32_is_close_to_float64():
    x, y = images(40, 50, 3)
    (exact,) = torch.autograd.grad(ssim(x, y), x)
    x32 = x.detach().float().requires_grad_()
    value = ssim(x32, y.float())
    (ours,) = torch.autograd.grad(value, x32)
    assert abs(value.item() - ssim(x, y).item()) < 1e-6
    assert (ours - exact).norm() < 1e-4 * exact.norm()


def test_equals_torchmetrics_on_an_image_with_a_black_border():
    """Libraries pad in other ways; with ten black pixels around both images zero padding is all the same."""
    functional = pytest.importorskip("torchmetrics.functional.image")
    x, y = (torch.nn.functional.pad(z.detach(), (0, 0, 10, 10, 10, 10)) for z in images(30, 34, 3))
    channels_first = [z.permute(2, 0, 1)[None] for z in (x, y)]
    _, full = functional.structural_similarity_index_measure(
        *channels_first, data_range=1.0, sigma=1.5, kernel_size=11, return_full_image=True
    )
    torch.testing.assert_close(ssim(x, y), full.mean(), rtol=1e-6, atol=1e-6)


def test_laws():
    x, y = images(20, 30, 3)
    assert ssim(x, x.detach()).item() == pytest.approx(1, abs=1e-12)
    assert -1 <= ssim(x, y).item() < 1
    assert ssim(x, y).item() == pytest.approx(ssim(y, x.detach()).item(), abs=1e-14)
    turned = ssim(x.transpose(0, 1), y.transpose(0, 1))
    assert turned.item() == pytest.approx(ssim(x, y).item(), abs=1e-12)


@pytest.mark.parametrize("other", [torch.zeros(5, 5, 3), torch.zeros(5, 6, 3, dtype=torch.float64)])
def test_unequal_images_are_refused(other):
    with pytest.raises(ValueError, match="ssim compares"):
        ssim(torch.zeros(5, 6, 3), other)
