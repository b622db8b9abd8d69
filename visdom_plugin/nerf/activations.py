"""Activations behind the networks of radiance fields: outputs to density and colours.

On the CPU in float32 each is one kernel, forward and back, with an exponential of its own: torch's may differ in
the last bit between the middle and the end of what a thread takes, so results would depend on how many there are.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

NUMBERS_PER_PIECE = 16384
LARGEST = 30.0
"""Logarithm of a density, at most."""
STEEPEST = math.exp(15)
"""Where the gradient of a density stops to grow."""


def density_of(outputs: Tensor, bias: float = 0.0) -> tuple[Tensor, Tensor]:
    """Density from the first of a network's outputs: exp of it plus `bias`.

    Its gradient is cut off above exp(15), so that one wild density does not end the training, as in Instant-NGP.

    Args:
        outputs: (..., n).

    Returns:
        density (...), and the outputs once more, for what makes colours of the others: their gradient then goes
        into the same array as the density's.
    """
    flat = outputs.reshape(-1, outputs.shape[-1])
    density, again = _Density.apply(flat, bias)
    return density.reshape(outputs.shape[:-1]), again.reshape(outputs.shape)


def padded_sigmoid(x: Tensor, padding: float = 0.0) -> Tensor:
    """Sigmoid from -padding to 1 + padding (mip-NeRF), of (...)."""
    if _is_plain(x):
        return _Sigmoid.apply(x, padding)
    return x.sigmoid() * (1 + 2 * padding) - padding


def _is_plain(x: Tensor) -> bool:
    return x.device.type == "cpu" and x.dtype == torch.float32


def _flat(x: Tensor) -> np.ndarray:
    return x.detach().contiguous().numpy().reshape(-1)


class _Density(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, outputs: Tensor, bias: float) -> tuple[Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        if _is_plain(outputs):
            density = torch.empty(len(outputs))
            numbers = outputs.shape[1], np.float32(bias), _flat(outputs), _flat(density)
            parallel_for(find_density, len(density), NUMBERS_PER_PIECE, *numbers)
        else:
            density = torch.exp((outputs[:, 0] + bias).clamp(max=LARGEST))
        ctx.save_for_backward(density)
        ctx.width = outputs.shape[1]
        return density, outputs.view_as(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_density: Tensor | None, g_outputs: Tensor | None) -> tuple[Tensor | None, None]:
        (density,) = ctx.saved_tensors
        if g_density is None:
            return g_outputs, None
        if not _is_plain(density):
            slope = g_density * density.clamp(max=STEEPEST)
            g = density.new_zeros(len(density), ctx.width) if g_outputs is None else g_outputs.clone()
            g[:, 0] += slope
            return g, None
        g = torch.empty(len(density), ctx.width)
        others = np.empty(0, np.float32) if g_outputs is None else _flat(g_outputs)
        numbers = ctx.width, _flat(density), _flat(g_density), others, _flat(g)
        parallel_for(density_back, len(density), NUMBERS_PER_PIECE, *numbers)
        return g, None


class _Sigmoid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, padding: float) -> Tensor:
        out = torch.empty(x.shape)
        ctx.padding = np.float32(padding)
        parallel_for(find_sigmoid, x.numel(), NUMBERS_PER_PIECE, _flat(x), ctx.padding, _flat(out))
        ctx.save_for_backward(out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_out: Tensor) -> tuple[Tensor, None]:
        (out,) = ctx.saved_tensors
        g = torch.empty(out.shape)
        numbers = _flat(out), ctx.padding, _flat(g_out), _flat(g)
        parallel_for(sigmoid_back, out.numel(), NUMBERS_PER_PIECE, *numbers)
        return g, None


@kernel(inline="always")
def _exp(x):
    """exp of a float32 within 2e-7 relative; 0 below exp(-87), and NaN for NaN. Without branches, for loops that
    become vectors: 2^n times a polynomial in what is left (Cephes)."""
    real = np.float32
    safe = x if x > real(-87) else real(-87)
    safe = safe if safe < real(88) else real(88)
    whole = safe * real(1.44269504) + real(12582912)  # 1.5 times 2^23: what follows the point is rounded away
    n = whole - real(12582912)
    r = safe - n * real(0.693359375)
    r = r - n * real(-2.12194440e-4)
    p = real(1.9875691500e-4)
    p = p * r + real(1.3981999507e-3)
    p = p * r + real(8.3334519073e-3)
    p = p * r + real(4.1665795894e-2)
    p = p * r + real(1.6666665459e-1)
    p = p * r + real(5.0000001201e-1)
    y = p * r * r + r + real(1)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    y = y * power
    y = real(0) if x < real(-87) else y
    return y if x == x else x


@kernel(error_model="numpy")
def find_density(begin, end, width, bias, outputs, density):
    largest = np.float32(LARGEST)
    rows = outputs[begin * width : end * width]
    logs = density[begin:end]
    for i in range(end - begin):
        logs[i] = rows[i * width] + bias
    for i in range(end - begin):
        x = logs[i]
        logs[i] = _exp(largest if x > largest else x)


@kernel(error_model="numpy")
def density_back(begin, end, width, density, g_density, g_outputs, g):
    steepest = np.float32(STEEPEST)
    rows = g[begin * width : end * width]
    given = g_outputs[begin * width : end * width]
    for i in range(len(given)):
        rows[i] = given[i]
    for i in range(len(given), len(rows)):
        rows[i] = np.float32(0)
    y, slope = density[begin:end], g_density[begin:end]
    for i in range(end - begin):
        rows[i * width] += slope[i] * (steepest if y[i] > steepest else y[i])


@kernel(error_model="numpy")
def find_sigmoid(begin, end, x, padding, out):
    one = np.float32(1)
    scale = one + padding + padding
    given, to = x[begin:end], out[begin:end]
    for i in range(end - begin):
        to[i] = scale / (one + _exp(-given[i])) - padding


@kernel(error_model="numpy")
def sigmoid_back(begin, end, out, padding, g_out, g):
    one = np.float32(1)
    scale = one + padding + padding
    values, given, to = out[begin:end], g_out[begin:end], g[begin:end]
    for i in range(end - begin):
        y = (values[i] + padding) / scale
        to[i] = given[i] * (scale * y * (one - y))
