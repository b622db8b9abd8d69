"""Structural similarity (Wang et al. 2004) as a loss and a metric: 11 x 11 Gaussian window of sigma 1.5,
zero padding, images in [0, 1], as 3DGS has it."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.lanes import WIDTH, count_up, fill, load, store, totals, where
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
    return l1_with_ssim(x, y, 0.0, 1.0)


def l1_with_ssim(x: Tensor, y: Tensor, by_l1: float, by_ssim: float, constant: float = 0.0) -> Tensor:
    """by_l1 mean(|x - y|) + by_ssim ssim + constant, on the CPU in one pass over both images.

    Args:
        x, y: as for `ssim`, which checks them.
    """
    y = y.detach()
    if x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64) and _fits(x):
        return _Compare.apply(x, y, x.requires_grad, by_l1, by_ssim, constant)
    return by_l1 * (x - y).abs().mean() + by_ssim * _ssim_by_convolution(x, y) + constant


def _fits(x: Tensor) -> bool:
    """Whether a row of an image fills a vector."""
    return x.shape[-2] * x.shape[-1] >= WIDTH


@cache
def _window(dtype: np.dtype | type[np.floating] = np.float64) -> np.ndarray:
    weights = np.exp(-0.5 * (np.arange(TAPS) - RADIUS) ** 2 / SIGMA**2)
    return (weights / weights.sum()).astype(dtype)


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


class _Compare(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, y, with_slopes, by_l1, by_ssim, constant):
        shape = x.shape
        images = [
            np.ascontiguousarray(z.detach().numpy()).reshape(-1, shape[-3], shape[-2] * shape[-1])
            for z in (x, y)
        ]
        count, height, _ = images[0].shape
        window = _window(images[0].dtype)
        sums = np.empty((count * height, 2), np.float64)
        slopes = np.empty((3, *images[0].shape) if with_slopes else (3, 0, 0, 0), images[0].dtype)
        parallel_for(_similarity, count * height, ROWS_PER_PIECE, *images, shape[-1], window, sums, slopes)
        ctx.save_for_backward(x, y)
        ctx.rest = (shape[-1], window, slopes, by_l1, by_ssim)
        l1, similarity = (total / max(images[0].size, 1) for total in sums.sum(0).tolist())
        loss = by_l1 * l1 + by_ssim * similarity + constant
        return torch.from_numpy(np.array(loss, images[0].dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx, by_loss):
        x, y = ctx.saved_tensors
        channels, window, slopes, *weights = ctx.rest
        images = [np.ascontiguousarray(z.detach().numpy()).reshape(slopes.shape[1:]) for z in (x, y)]
        out = np.empty_like(images[0])
        scales = np.array([float(by_loss) * w / max(out.size, 1) for w in weights], out.dtype)
        parallel_for(
            _gradient, out.shape[0] * out.shape[1], ROWS_PER_PIECE, *images, channels, window, slopes, scales, out
        )  # fmt: skip
        return torch.from_numpy(out).reshape(x.shape), None, None, None, None, None


@kernel(error_model="numpy")
def _similarity(begin, end, x, y, channels, window, sums, slopes):
    """Rows begin .. end - 1 of all images (B, H, W C): sums (rows, 2) of the absolute difference and of the
    similarity, and, unless it is empty, slopes (3, B, H, W C): its derivatives by the blurred x, x^2 and x y.

    The last vector of a row ends where the row ends: it repeats part of the one before.
    """
    _, height, size = x.shape
    real = x.dtype.type
    zero, one, two, c1, c2 = real(0), real(1), real(2), real(C1), real(C2)
    edge, area = RADIUS * channels, x.size
    stride = size + 2 * edge
    maps, row_sums = np.zeros(4 * stride, x.dtype), np.empty(WIDTH, x.dtype)
    for row in range(begin, end):
        v = row % height
        first, last = max(0, RADIUS - v), min(TAPS, height + RADIUS - v)
        for j0 in range(0, size, WIDTH):
            j = min(j0, size - WIDTH)
            blur_x, blur_y = fill(zero), fill(zero)
            squares, products = fill(zero), fill(zero)
            for tap in range(first, last):
                at = (row + tap - RADIUS) * size + j
                a, b, weight = load(x, at), load(y, at), window[tap]
                blur_x, blur_y = blur_x + a * weight, blur_y + b * weight
                squares, products = squares + (a * a + b * b) * weight, products + a * b * weight
            at = edge + j
            store(maps, at, blur_x)
            store(maps, at + stride, blur_y)
            store(maps, at + 2 * stride, squares)
            store(maps, at + 3 * stride, products)
        differences, similarities = fill(zero), fill(zero)
        for j0 in range(0, size, WIDTH):
            j = min(j0, size - WIDTH)
            mx, my = fill(zero), fill(zero)
            squares, products = fill(zero), fill(zero)
            for tap in range(TAPS):
                at, weight = tap * channels + j, window[tap]
                mx, my = mx + load(maps, at) * weight, my + load(maps, at + stride) * weight
                squares = squares + load(maps, at + 2 * stride) * weight
                products = products + load(maps, at + 3 * stride) * weight
            means = mx * mx + my * my
            d1, d2 = one / (means + c1), one / (squares - means + c2)
            n1, n2 = two * mx * my + c1, two * (products - mx * my) + c2
            value = n1 * n2 * d1 * d2
            fresh = count_up(real(j)) >= real(j0)
            apart = load(x, row * size + j) - load(y, row * size + j)
            differences = differences + where(fresh, where(apart < zero, zero - apart, apart), zero)
            similarities = similarities + where(fresh, value, zero)
            if slopes.size:
                by_xx, by_xy = zero - value * d2, two * n1 * d1 * d2
                # x's mean acts directly and through the variance and covariance.
                by_mean = two * (my * n2 * d1 * d2 - mx * value * d1) - two * mx * by_xx - my * by_xy
                at = row * size + j
                store(slopes, at, by_mean)
                store(slopes, at + area, by_xx)
                store(slopes, at + 2 * area, by_xy)
        store(row_sums, 0, totals((differences, similarities)))
        sums[row, 0], sums[row, 1] = row_sums[0], row_sums[1]


@kernel(error_model="numpy")
def _gradient(begin, end, x, y, channels, window, slopes, scales, out):
    """Rows begin .. end - 1 of the gradient by x, scales (2,) times those of the mean difference and similarity.

    The window is its own transpose, so slopes are blurred again.
    """
    _, height, size = x.shape
    real = x.dtype.type
    zero, two = real(0), real(2)
    edge, area = RADIUS * channels, x.size
    stride = size + 2 * edge
    maps = np.zeros(3 * stride, x.dtype)
    by_l1, by_similarity = scales[0], scales[1]
    for row in range(begin, end):
        v = row % height
        first, last = max(0, RADIUS - v), min(TAPS, height + RADIUS - v)
        for j0 in range(0, size, WIDTH):
            j = min(j0, size - WIDTH)
            by_mean, by_xx, by_xy = fill(zero), fill(zero), fill(zero)
            for tap in range(first, last):
                at, weight = (row + tap - RADIUS) * size + j, window[tap]
                by_mean = by_mean + load(slopes, at) * weight
                by_xx = by_xx + load(slopes, at + area) * weight
                by_xy = by_xy + load(slopes, at + 2 * area) * weight
            store(maps, edge + j, by_mean)
            store(maps, edge + j + stride, by_xx)
            store(maps, edge + j + 2 * stride, by_xy)
        for j0 in range(0, size, WIDTH):
            j = min(j0, size - WIDTH)
            by_mean, by_xx, by_xy = fill(zero), fill(zero), fill(zero)
            for tap in range(TAPS):
                at, weight = tap * channels + j, window[tap]
                by_mean = by_mean + load(maps, at) * weight
                by_xx = by_xx + load(maps, at + stride) * weight
                by_xy = by_xy + load(maps, at + 2 * stride) * weight
            a, b = load(x, row * size + j), load(y, row * size + j)
            side = where(a > b, by_l1, where(a < b, -by_l1, fill(zero)))
            slope = by_mean + two * a * by_xx + b * by_xy
            store(out, row * size + j, side + slope * by_similarity)
