"""Structural similarity (Wang et al. 2004) as a loss and a metric: 11 x 11 Gaussian window of sigma 1.5,
zero padding, images in [0, 1], as 3DGS has it."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

RADIUS = 5
TAPS = 2 * RADIUS + 1
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
ROWS_PER_PIECE = 16


def ssim(x: Tensor, y: Tensor) -> Tensor:
    """Mean structural similarity of two images.

    Args:
        x, y: (..., H, W, C) in [0, 1], same floating dtype and device. Differentiable in x; y is a constant.

    Returns:
        Scalar in [-1, 1], 1 for equal images.
    """
    if x.shape != y.shape or x.ndim < 3:
        raise ValueError(
            f"ssim compares (..., H, W, C) images of one shape, got {tuple(x.shape)} and {tuple(y.shape)}"
        )
    if x.dtype != y.dtype:
        raise ValueError(f"ssim compares images of one dtype, got {x.dtype} and {y.dtype}")
    if x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64):
        return _Ssim.apply(x, y.detach(), x.requires_grad)
    return _ssim_by_convolution(x, y.detach())


def _window() -> np.ndarray:
    weights = np.exp(-0.5 * (np.arange(TAPS) - RADIUS) ** 2 / SIGMA**2)
    return weights / weights.sum()


@cache
def _window_on(device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):  # training may come after an evaluation that had it on
        return torch.from_numpy(_window()).to(device, dtype)


def _ssim_by_convolution(x: Tensor, y: Tensor) -> Tensor:
    """The same on any device."""
    x, y = (z.reshape(-1, *z.shape[-3:]).permute(0, 3, 1, 2).flatten(0, 1)[:, None] for z in (x, y))
    window = _window_on(x.device, x.dtype)
    maps = torch.cat([x, y, x * x, y * y, x * y], 1).flatten(0, 1)[:, None]
    maps = torch.conv2d(maps, window.reshape(1, 1, TAPS, 1), padding=(RADIUS, 0))
    maps = torch.conv2d(maps, window.reshape(1, 1, 1, TAPS), padding=(0, RADIUS))
    mx, my, xx, yy, xy = maps.reshape(-1, 5, *x.shape[-2:]).unbind(1)
    luminance = (2 * mx * my + C1) / (mx * mx + my * my + C1)
    contrast = (2 * (xy - mx * my) + C2) / (xx - mx * mx + yy - my * my + C2)
    return (luminance * contrast).mean()


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, y, with_slopes):
        shape = x.shape
        images = [
            z.detach().reshape(-1, shape[-3], shape[-2] * shape[-1]).contiguous().numpy() for z in (x, y)
        ]
        count, height, _ = images[0].shape
        window = _window().astype(images[0].dtype)
        sums = np.zeros(count * height, np.float64)
        slopes = np.empty((3, *images[0].shape) if with_slopes else (3, 0, 0, 0), images[0].dtype)
        parallel_for(_similarity, count * height, ROWS_PER_PIECE, *images, shape[-1], window, sums, slopes)
        ctx.save_for_backward(x, y)
        ctx.rest = (shape[-1], window, slopes)
        return x.new_tensor(sums.sum() / max(images[0].size, 1))

    @staticmethod
    @once_differentiable
    def backward(ctx, g):
        x, y = ctx.saved_tensors
        channels, window, slopes = ctx.rest
        images = [z.detach().reshape(slopes.shape[1:]).contiguous().numpy() for z in (x, y)]
        out = np.empty_like(images[0])
        scale = out.dtype.type(float(g) / max(out.size, 1))
        parallel_for(
            _gradient,
            out.shape[0] * out.shape[1],
            ROWS_PER_PIECE,
            *images,
            channels,
            window,
            slopes,
            scale,
            out,
        )
        return torch.from_numpy(out).reshape(x.shape), None, None


@kernel(fast=True)
def _blur_across(padded, channels, window, out):
    """Blurs one row (W C,) given with RADIUS pixels of zeros on both sides."""
    for j in range(len(out)):
        out[j] = 0
    for tap in range(TAPS):
        weight, source = window[tap], padded[tap * channels : tap * channels + len(out)]
        for j in range(len(out)):
            out[j] += weight * source[j]


@kernel(fast=True)
def _add_products(x, y, weight, mx, my, xx, yy, xy):
    for j in range(len(x)):
        a, b = x[j], y[j]
        wa, wb = weight * a, weight * b
        mx[j] += wa
        my[j] += wb
        xx[j] += wa * a
        yy[j] += wb * b
        xy[j] += wa * b


@kernel(fast=True)
def _compare(maps):
    """Sum of the similarity over one row; turns the first three rows of `maps` into its derivatives."""
    real = maps.dtype.type
    c1, c2, one, two = real(C1), real(C2), real(1), real(2)
    mean_x, mean_y, square_x, square_y, product = maps[0], maps[1], maps[2], maps[3], maps[4]
    total = real(0)
    for j in range(maps.shape[1]):
        mx, my = mean_x[j], mean_y[j]
        d1 = one / (mx * mx + my * my + c1)
        d2 = one / (square_x[j] - mx * mx + square_y[j] - my * my + c2)
        n1, n2 = two * mx * my + c1, two * (product[j] - mx * my) + c2
        value = n1 * n2 * d1 * d2
        total += value
        by_xx, by_xy = -value * d2, two * n1 * d1 * d2
        # x's mean acts directly and through the variance and covariance.
        mean_x[j] = two * (my * n2 * d1 * d2 - mx * value * d1) - two * mx * by_xx - my * by_xy
        mean_y[j], square_x[j] = by_xx, by_xy
    return total


@kernel(error_model="numpy")
def _similarity(begin, end, x, y, channels, window, sums, slopes):
    """Rows begin .. end - 1 of all images (B, H, W C): sums (rows,), and slopes (3, B, H, W C) unless empty."""
    _, height, size = x.shape
    edge = RADIUS * channels
    padded = np.zeros((5, size + 2 * edge), x.dtype)
    maps = np.empty((5, size), x.dtype)
    for row in range(begin, end):
        image, v = row // height, row % height
        inner = padded[:, edge : edge + size]
        inner[:] = 0
        for tap in range(max(0, RADIUS - v), min(TAPS, height + RADIUS - v)):
            r = v + tap - RADIUS
            _add_products(
                x[image, r], y[image, r], window[tap], inner[0], inner[1], inner[2], inner[3], inner[4]
            )
        for k in range(5):
            _blur_across(padded[k], channels, window, maps[k])
        sums[row] = _compare(maps)
        if slopes.size:
            for k in range(3):
                slopes[k, image, v] = maps[k]


@kernel(error_model="numpy")
def _gradient(begin, end, x, y, channels, window, slopes, scale, out):
    """Rows begin .. end - 1 of the gradient by x: the window is its own transpose, so slopes are blurred again."""
    _, height, size = x.shape
    edge = RADIUS * channels
    padded = np.zeros((3, size + 2 * edge), x.dtype)
    maps = np.empty((3, size), x.dtype)
    for row in range(begin, end):
        image, v = row // height, row % height
        for k in range(3):
            inner = padded[k, edge : edge + size]
            inner[:] = 0
            for tap in range(max(0, RADIUS - v), min(TAPS, height + RADIUS - v)):
                weight, source = window[tap], slopes[k, image, v + tap - RADIUS]
                for j in range(size):
                    inner[j] += weight * source[j]
            _blur_across(padded[k], channels, window, maps[k])
        for j in range(size):
            slope = maps[0, j] + x.dtype.type(2) * x[image, v, j] * maps[1, j] + y[image, v, j] * maps[2, j]
            out[image, v, j] = scale * slope
