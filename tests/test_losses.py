"""Losses by their definitions."""

import torch

from visdom_plugin.losses import disparity_loss, mask_loss, photometric_loss
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
