"""Laws of the hash grid, on every backend that runs here, and parity with the slow twin."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.nerf.encoding import hash_twin
from visdom_plugin.errors import ConfigError
from visdom_plugin.nerf.encoding import hash_grid
from visdom_plugin.nerf.encoding.hash_grid import (
    HashLayout,
    default_backend,
    encode,
    encode_mean,
    encode_spread,
    initial_table,
    mean_square_per_level,
)

SMALL = HashLayout(levels=4, features=2, base_resolution=3, max_resolution=24, log2_table_size=9)
"""Two dense and two hashed levels."""

BACKENDS = ("cpu", "torch")


def drawn(seed, *shape, low=0.0, high=1.0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator)


def table_of(layout, seed=1):
    return initial_table(layout, torch.Generator().manual_seed(seed), 1.0).requires_grad_()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("features", "samples"), [(1, 6), (2, 1), (3, 2), (4, 6)])
def test_same_as_twin(backend, features, samples):
    layout = replace(SMALL, features=features)
    table = table_of(layout)
    points = drawn(2, 60, samples, 3, low=-0.1, high=1.1)
    scales = drawn(3, 60, samples, high=0.3) ** 2
    scales[0], scales[1] = 0, 1e3
    for weighted in (scales, None):
        if weighted is None:
            points, samples = points[:, :1], 1
            features_out = encode(points[:, 0], table, layout, backend)
        else:
            features_out, weights = encode_mean(points, scales, table, layout, backend)
        g_out = torch.randn(features_out.shape, generator=torch.Generator().manual_seed(4))
        (g_table,) = torch.autograd.grad(features_out, table, g_out)
        arrays = (None if x is None else x.detach().double().numpy() for x in (points, weighted, table))
        expected = hash_twin.encode_mean(*arrays, layout, g_out.double().numpy())
        np.testing.assert_allclose(features_out.detach(), expected[0], rtol=0, atol=5e-6)
        np.testing.assert_allclose(g_table, expected[2], rtol=0, atol=2e-5)
        if weighted is not None:
            np.testing.assert_allclose(weights, expected[1], rtol=2e-6)
            assert not weights.requires_grad


def test_same_as_torch_over_many_blocks():
    """More points than a block holds, and a last block that is not full."""
    layout = HashLayout(levels=5, features=4, base_resolution=7, max_resolution=200, log2_table_size=12)
    table = table_of(layout)
    for samples in (1, 6, 256):
        points, scales = drawn(5, 1500 // samples, samples, 3), drawn(6, 1500 // samples, samples, high=0.02)
        results = []
        for backend in BACKENDS:
            out, weights = encode_mean(points, scales, table, layout, backend)
            (g_table,) = torch.autograd.grad(out, table, torch.cos(torch.arange(out.numel())).view_as(out))
            results.append((out, weights, g_table))
        for one, other in zip(*results, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradient_is_that_of_finite_differences(backend):
    """The encoding is linear in the table, so differences of any width are exact up to rounding."""
    table, points, scales = table_of(SMALL), drawn(7, 50, 3, 3), drawn(8, 50, 3, high=0.1)

    def loss(t):
        return encode_mean(points, scales, t, SMALL, backend)[0].double().square().sum()

    (gradient,) = torch.autograd.grad(loss(table), table)
    direction = torch.randn(table.shape, generator=torch.Generator().manual_seed(9))
    with torch.no_grad():
        difference = (loss(table + 0.5 * direction) - loss(table - 0.5 * direction)).item()
    assert difference == pytest.approx((gradient.double() * direction).sum().item(), rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_constant_table_gives_the_constant(backend):
    constant = torch.tensor([3.0, -0.25])
    table = constant.expand(SMALL.rows, 2).contiguous()
    out = encode(drawn(10, 500, 3, low=-0.5, high=1.5), table, SMALL, backend)
    torch.testing.assert_close(out, constant.repeat(SMALL.levels).expand_as(out), rtol=1e-6, atol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_dense_level_reproduces_linear_functions(backend):
    """With each vertex's own position in the table, the encoding is the clamped point: rows are told apart."""
    layout = HashLayout(levels=1, features=3, base_resolution=6, max_resolution=6, log2_table_size=9)
    z, y, x = torch.meshgrid(*[torch.arange(7) / 6] * 3, indexing="ij")
    table = torch.stack([x, y, z], -1).reshape(-1, 3)
    points = drawn(11, 1000, 3, low=-0.2, high=1.2)
    torch.testing.assert_close(encode(points, table, layout, backend), points.clamp(0, 1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_continuous_across_borders_of_cells(backend, axis):
    table = table_of(SMALL)
    for resolution in SMALL.resolutions:
        points = drawn(12, resolution - 1, 3)
        points[:, axis] = torch.arange(1, resolution) / resolution
        step = torch.zeros(3)
        step[axis] = 2e-6
        below, above = (encode(p, table, SMALL, backend) for p in (points - step, points + step))
        # Features lie in [-1, 1], so along an axis they change by at most 2 per cell.
        assert (above - below).abs().max() < 2 * SMALL.max_resolution * 4e-6 * 2


@pytest.mark.parametrize("backend", BACKENDS)
def test_points_outside_are_clamped_and_nan_counts_as_zero(backend):
    table, points = table_of(SMALL), drawn(13, 200, 3, low=-2, high=3)
    points[0, 1], points[1, 0], points[2, 2] = float("nan"), float("inf"), -float("inf")
    inside = torch.nan_to_num(points, nan=0.0).clamp(0, 1)
    assert torch.equal(encode(points, table, SMALL, backend), encode(inside, table, SMALL, backend))


@pytest.mark.parametrize("backend", BACKENDS)
def test_single_sharp_samples_encode_as_points_do(backend):
    table, points = table_of(SMALL), drawn(14, 300, 1, 3)
    plain = encode(points[:, 0], table, SMALL, backend)
    for scale in (0.0, 1e-9, 1e-4):
        out, weights = encode_mean(points, torch.full((300, 1), scale), table, SMALL, backend)
        torch.testing.assert_close(out, plain, rtol=0, atol=2e-6)
        assert weights.max() <= 1
        assert weights.min() > 1 - 2e-6


def test_wide_samples_fade_in_proportion_to_their_scale():
    table, points = table_of(SMALL), drawn(15, 20, 2, 3)
    (one, weight), (other, other_weight) = (
        encode_mean(points, torch.full((20, 2), scale), table, SMALL) for scale in (1e3, 1e4)
    )
    torch.testing.assert_close(weight, 10 * other_weight, rtol=1e-5, atol=0)
    torch.testing.assert_close(one, 10 * other, rtol=1e-4, atol=1e-10)


@pytest.mark.parametrize("backend", BACKENDS)
def test_leading_dimensions_strides_and_nothing(backend):
    table, points, scales = table_of(SMALL), drawn(16, 3, 4, 5, 3), drawn(17, 3, 4, 5, high=0.1)
    flat = encode(points.reshape(-1, 3), table, SMALL, backend)
    assert torch.equal(encode(points, table, SMALL, backend), flat.reshape(3, 4, 5, -1))
    assert torch.equal(encode(points[1, 2, 3], table, SMALL, backend), flat.reshape(3, 4, 5, -1)[1, 2, 3])
    out, weights = encode_mean(points, scales, table, SMALL, backend)
    assert out.shape == (3, 4, SMALL.width)
    assert weights.shape == (3, 4, SMALL.levels)
    turned = encode_mean(points.transpose(0, 1), scales.transpose(0, 1), table, SMALL, backend)
    torch.testing.assert_close(turned[0].transpose(0, 1), out)
    torch.testing.assert_close(turned[1].transpose(0, 1), weights)
    nothing = encode(points[:0], table, SMALL, backend)
    assert nothing.shape == (0, 4, 5, SMALL.width)
    nothing.sum().backward()
    assert not table.grad.any()


def test_same_bits_for_every_number_of_threads():
    layout = HashLayout(levels=7, features=2, base_resolution=16, max_resolution=256, log2_table_size=13)
    table, points, scales = table_of(layout), drawn(18, 3000, 4, 3), drawn(19, 3000, 4, high=0.05)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            out, weights = encode_mean(points, scales, table, layout)
            (g_table,) = torch.autograd.grad(out, table, torch.sin(torch.arange(out.numel())).view_as(out))
            results.append((out, weights, g_table))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_layout():
    layout = HashLayout(levels=10, base_resolution=16, max_resolution=8192, log2_table_size=21)
    assert layout.resolutions == tuple(16 * 2**i for i in range(10))
    assert layout.dense == (True,) * 3 + (False,) * 7  # 65^3 fits into 2^21 rows, 129^3 does not
    assert layout.offsets[-1] == layout.rows == 17**3 + 33**3 + 65**3 + 7 * 2**21
    assert HashLayout(levels=1, base_resolution=4, max_resolution=9).resolutions == (4,)
    for wrong in ({"levels": 0}, {"base_resolution": 600}, {"log2_table_size": 30}):
        with pytest.raises(ConfigError):
            HashLayout(**wrong)


def test_initial_table_and_mean_squares():
    table = initial_table(SMALL, torch.Generator().manual_seed(0), 0.5)
    assert table.abs().max() <= 0.5
    assert table.min() < -0.49 < 0.49 < table.max()
    squares = mean_square_per_level(table, SMALL)
    for level in range(SMALL.levels):
        rows = table[SMALL.offsets[level] : SMALL.offsets[level + 1]]
        assert squares[level].item() == pytest.approx(rows.double().square().mean().item(), rel=1e-5)


def test_mean_squares_agree_with_torch_on_any_number_of_threads():
    layout = HashLayout(levels=3, features=3, base_resolution=3, max_resolution=40, log2_table_size=13)
    table = initial_table(layout, torch.Generator().manual_seed(0), 0.5)
    slow = mean_square_per_level(table.double(), layout)  # float64 takes plain torch
    before, fast = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            fast.append(mean_square_per_level(table, layout))
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(fast[0].double(), slow, rtol=1e-6, atol=1e-12)
    assert torch.equal(*fast)
    assert mean_square_per_level(table.requires_grad_(), layout).requires_grad


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("used", ["features", "squares", "both"])
def test_spread_encoding_equals_its_parts(used, backend, monkeypatch):
    """Features, what levels leave out, and mean squares, with the gradient of the first and the last."""
    monkeypatch.setattr(hash_grid, "default_backend", lambda device: backend)
    table = table_of(SMALL)
    points, scales = drawn(2, 20, 6, 3), drawn(3, 20, 6, high=0.3) ** 2
    squares = mean_square_per_level(table.detach(), SMALL)
    fast = encode_spread(points, scales, table, SMALL, squares, 0.1)
    features, weights = encode_mean(points, scales, table, SMALL, "torch")
    left_out = (2 * weights - 1) * (0.1**2 + squares).sqrt()
    slow = features, left_out, mean_square_per_level(table, SMALL)
    torch.testing.assert_close(fast, slow, rtol=1e-5, atol=2e-6)
    assert not fast[1].requires_grad
    g = (
        torch.randn(features.shape, generator=torch.Generator().manual_seed(4)),
        torch.tensor([1.0, -2, 3, 40]),
    )
    chosen = {"features": [0], "squares": [2], "both": [0, 2]}[used]
    totals = [sum((out[i] * g[i // 2]).sum() for i in chosen) for out in (fast, slow)]
    gradients = [torch.autograd.grad(total, table)[0] for total in totals]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=2e-5)


def test_mismatches_are_told():
    table, points = table_of(SMALL), torch.zeros(4, 3)
    assert default_backend(table.device) == "cpu"
    with pytest.raises(ConfigError, match="backend"):
        encode(points, table, SMALL, "abacus")
    with pytest.raises(ValueError, match="table"):
        encode(points, table[:-1], SMALL)
    with pytest.raises(ValueError, match="points"):
        encode(points[:, :2], table, SMALL)
    with pytest.raises(ValueError, match="scales"):
        encode_mean(points, torch.zeros(3), table, SMALL)
    with pytest.raises(ValueError, match="256 at most"):
        encode_mean(torch.zeros(1, 257, 3), torch.zeros(1, 257), table, SMALL)


TRITON_PROGRAM = """
import torch
from visdom_plugin.nerf.encoding.hash_grid import HashLayout, encode, encode_mean, initial_table

device = "cuda" if torch.cuda.is_available() else "cpu"
draw = torch.Generator().manual_seed(0)
for features, samples in ((1, 6), (3, 1), (4, 2)):
    layout = HashLayout(3, features, base_resolution=5, max_resolution=60, log2_table_size=9)
    table = initial_table(layout, draw, 1.0).to(device).requires_grad_()
    points = (torch.rand(150, samples, 3, generator=draw) * 1.2 - 0.1).to(device)
    scales = (torch.rand(150, samples, generator=draw) * 0.2).to(device)
    scales[0] = 0
    results = []
    for backend in ("triton", "torch"):
        plain = encode(points, table, layout, backend)
        mean, weights = encode_mean(points, scales, table, layout, backend)
        loss = (plain.square().sum() + mean.square().sum())
        results.append((plain, mean, weights, *torch.autograd.grad(loss, table)))
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
print("agreed")
"""


@pytest.mark.slow
@pytest.mark.skipif(not importlib.util.find_spec("triton"), reason="triton is not installed")
def test_triton_agrees_with_torch():
    """On the GPU where there is one, else in Triton's interpreter, which must be chosen before it is imported."""
    environment = os.environ | ({} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"})
    done = subprocess.run(
        [sys.executable, "-c", TRITON_PROGRAM], env=environment, capture_output=True, text=True
    )
    assert done.stdout.strip() == "agreed", done.stderr


CACHE_PROGRAM = """
import hashlib, torch
from visdom_plugin.nerf.encoding.hash_grid import HashLayout, encode, encode_mean, initial_table

digest, draw = hashlib.sha256(), torch.Generator().manual_seed(0)
for features in (1, 2, 3, 4):
    layout = HashLayout(6, features, max_resolution=300, log2_table_size=12)
    table = initial_table(layout, draw, 1.0).requires_grad_()
    points, scales = torch.rand(3000, 2, 3, generator=draw), torch.rand(3000, 2, generator=draw) * 0.05
    plain = encode(points, table, layout)
    mean, weights = encode_mean(points, scales, table, layout)
    (plain.square().sum() + mean.square().sum()).backward()
    for t in (plain.detach(), mean.detach(), weights, table.grad):
        digest.update(t.numpy().tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_first_and_later_processes_agree_to_the_bit(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    digests = [
        subprocess.run(
            [sys.executable, "-c", CACHE_PROGRAM], env=environment, check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert any(tmp_path.rglob("*.nbc")), "nothing was cached, so nothing was tested"
    assert digests[0] == digests[1]
