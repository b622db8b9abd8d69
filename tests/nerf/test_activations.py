"""Density and colours from a network's outputs: the kernels against torch in float64."""

import math

import pytest
import torch

from visdom_plugin.nerf.activations import STEEPEST, density_of, padded_sigmoid


def outputs(n=40_001, width=5, dtype=torch.float32):
    x = 12 * torch.randn(n, width, generator=torch.Generator().manual_seed(0))
    return x.to(dtype).requires_grad_()


def density_and_slopes(x, rest=True):
    density, again = density_of(x, -1.0)
    draw = torch.Generator().manual_seed(1)
    by_density, by_rest = (torch.randn(t.shape, generator=draw).to(t) for t in (density, again))
    if rest:
        return density, again, torch.autograd.grad([density, again], x, [by_density, by_rest])[0]
    return density, again, torch.autograd.grad(density, x, by_density)[0]


@pytest.mark.parametrize("rest", [True, False])
def test_density_and_its_gradient_are_those_of_an_exponential_that_is_cut_off(rest):
    fast, slow = density_and_slopes(outputs(), rest), density_and_slopes(outputs(dtype=torch.float64), rest)
    for one, exact in zip(fast, slow, strict=True):
        torch.testing.assert_close(one.double(), exact, rtol=5e-6, atol=3e-7)
    x = torch.tensor([[40.0], [20.0], [1.0]], requires_grad=True)
    density, _ = density_of(x)
    assert density.tolist() == pytest.approx([math.exp(30), math.exp(20), math.e], rel=1e-6)
    (slope,) = torch.autograd.grad(density.sum(), x)
    assert slope[:, 0].tolist() == pytest.approx([STEEPEST, STEEPEST, math.e], rel=1e-6)


def test_the_outputs_alone_get_the_gradient_that_they_are_given():
    x = outputs(7)
    _, again = density_of(x)
    given = torch.arange(35.0).reshape(7, 5)
    assert torch.equal(torch.autograd.grad(again, x, given)[0], given)


@pytest.mark.parametrize("padding", [0.0, 0.001])
def test_sigmoid_and_its_gradient(padding):
    x = outputs()
    out = padded_sigmoid(x, padding)
    given = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
    exact = outputs(dtype=torch.float64)
    wanted = padded_sigmoid(exact, padding)
    torch.testing.assert_close(out.double(), wanted, rtol=0, atol=3e-7)
    slopes = torch.autograd.grad(out, x, given)[0], torch.autograd.grad(wanted, exact, given.double())[0]
    torch.testing.assert_close(slopes[0].double(), slopes[1], rtol=0, atol=1e-6)


def test_what_is_no_number_stays_so_and_infinities_have_their_limits():
    x = torch.tensor([math.nan, math.inf, -math.inf, 0.0])
    density, colour = density_of(x[:, None])[0], padded_sigmoid(x)
    assert density[0].isnan() and density[1:].tolist() == pytest.approx([math.exp(30), 0, 1], rel=1e-6)
    assert colour[0].isnan() and colour[1:].tolist() == pytest.approx([1, 0, 0.5], abs=1e-30)


def test_any_number_of_threads_gives_the_same_bits():
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append([*density_and_slopes(outputs()), padded_sigmoid(outputs())])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
