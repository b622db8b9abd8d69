"""Perceptrons: the kernel against its twin in torch."""

import pytest
import torch

from visdom_plugin.nerf import mlp
from visdom_plugin.nerf.mlp import perceptron, run_layers, run_layers_torch

SHAPES = {
    # points, numbers of x, of which lead, of extra, points that a row of extra serves, sizes, biases, again
    "density": (2500, 10, 0, 6, 1, [(16, 32), (32, 5)], False, None),
    "colour": (1200, 20, 1, 9, 12, [(28, 32), (60, 32), (32, 3)], True, 1),
    "odd sizes": (67, 7, 2, 0, 1, [(5, 7), (7, 18), (23, 1)], True, 2),
    "one layer": (9, 33, 0, 0, 1, [(33, 17)], False, None),
    "widest": (70, 96, 0, 0, 1, [(96, 96), (96, 96)], True, None),
}


def make(points, numbers, lead, more, serves, sizes, biased, again, dtype=torch.float32):
    draw = torch.Generator().manual_seed(1)
    layers = [torch.nn.Linear(n, m, bias=biased) for n, m in sizes]
    for layer in layers:
        for p in layer.parameters():
            p.data = torch.randn(p.shape, generator=draw) * layer.in_features**-0.5
        layer.to(dtype)
    x = torch.randn(points, numbers, generator=draw).to(dtype).requires_grad_()
    extra = torch.randn(points // serves, more, generator=draw).to(dtype) if more else None
    return layers, x, extra, {"lead": lead, "again": again}


def values(run, layers, x, extra, options):
    out = run(layers, x, extra, **options)
    slope = torch.randn(out.shape, generator=torch.Generator().manual_seed(2)).to(out)
    return [out, *torch.autograd.grad(out, [x, *(p for layer in layers for p in layer.parameters())], slope)]


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_kernel_agrees_with_torch_forward_and_backward(shape):
    exact = values(run_layers_torch, *make(*shape, dtype=torch.float64))
    for fast, slow in zip(values(run_layers, *make(*shape)), exact, strict=True):
        assert fast.shape == slow.shape
        scale = float(slow.detach().abs().max())
        torch.testing.assert_close(fast.double(), slow, rtol=0, atol=1e-5 * scale)


def test_narrow_nets_take_the_kernel_and_wide_ones_torch(monkeypatch):
    calls = []
    monkeypatch.setattr(mlp, "run_layers_torch", lambda *a, **k: calls.append(1) or run_layers_torch(*a, **k))
    values(run_layers, *make(*SHAPES["widest"]))
    assert not calls
    values(run_layers, *make(8, 97, 0, 0, 1, [(97, 8)], False, None))
    assert calls


def test_any_number_of_threads_gives_the_same_bits():
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(values(run_layers, *make(40_000, 10, 0, 6, 1, [(16, 32), (32, 5)], True, None)))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_no_points_and_leading_dimensions():
    net = perceptron([3, 8, 2], torch.Generator().manual_seed(0))
    assert net(torch.zeros(0, 3)).shape == (0, 2)
    x = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(net(x).reshape(20, 2), net(x.reshape(20, 3)), rtol=0, atol=0)
    (net(torch.zeros(0, 3)).sum() + 0).backward()
    assert all(p.grad is not None and not p.grad.any() for p in net.parameters())


def test_a_point_that_is_not_a_number_stays_one_and_harms_no_other():
    net = perceptron([3, 8, 2], torch.Generator().manual_seed(0))
    x = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    clean = net(x)
    x[7, 1] = torch.nan
    out = net(x)
    assert out[7].isnan().all()
    rest = torch.arange(20) != 7
    assert torch.equal(out[rest], clean[rest])
