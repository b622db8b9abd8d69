"""Tensors made from frozen noise: their sizes, what a point sees of them, and what is trained."""

import itertools

import pytest
import torch

from visdom_plugin.nerf.encoding.factors import LINES, PLANES, PlanesTimesLines, TwoVolumes
from visdom_plugin.nerf.encoding.noise_decoders import PlaneDecoder, StackDecoder

SIZES = (8, 3, 5, 4)
"""Channels and resolution of the noise, channels of the tensors, channels of the networks' finest level."""


def draw(seed=0):
    return torch.Generator().manual_seed(seed)


def tensorf(seed=0):
    return PlanesTimesLines(*SIZES, draw(seed))


def dif(seed=0, period=0.4):
    return TwoVolumes(*SIZES, period, draw(seed))


BOTH = pytest.mark.parametrize("build", [tensorf, dif])


def cube(n, seed=1):
    return 2 * torch.rand(n, 3, generator=draw(seed)) - 1


def interpolate(tensor, point):
    """(C,) the slow twin: a tensor (C, *sizes) at a point, one coordinate for each axis, its faces held beyond."""
    sizes = tensor.shape[1:]
    at = [min(max((float(x) + 1) / 2 * n - 0.5, 0), n - 1) for x, n in zip(point, sizes, strict=True)]
    found = torch.zeros(tensor.shape[0])
    for corner in itertools.product((0, 1), repeat=len(sizes)):
        index = [min(int(x) + d, n - 1) for x, d, n in zip(at, corner, sizes, strict=True)]
        weight = 1.0
        for x, d in zip(at, corner, strict=True):
            weight *= x - int(x) if d else 1 - (x - int(x))
        found += weight * tensor[(slice(None), *index)]
    return found


@pytest.mark.parametrize("beyond", [1.0, 1.3])
def test_planes_and_lines_are_those_of_the_slow_twin(beyond):
    factors = tensorf()
    with torch.no_grad():
        made = factors.make()
        points = beyond * cube(30)
        found = factors.look_up(points, made)
    # Sampled with the first named axis along the rows' direction.
    slow = [
        torch.cat(
            [
                interpolate(plane[0], [p[b], p[a]]) * interpolate(line[0, ..., 0], [p[axis]])
                for (a, b), axis, plane, line in zip(PLANES, LINES, made[:3], made[3:], strict=True)
            ]
        )
        for p in points
    ]
    assert found.shape == (30, factors.width) == (30, 15)
    torch.testing.assert_close(found, torch.stack(slow), atol=1e-5, rtol=1e-4)


def test_volumes_are_those_of_the_slow_twin_and_the_second_repeats():
    factors = dif()
    with torch.no_grad():
        made = factors.make()
        points = cube(20)
        found = factors.look_up(points, made)
        repeated = (points % 0.4) / 0.2 - 1
        slow = [
            torch.cat([interpolate(made[0][0], p.flip(0)), interpolate(made[1][0], q.flip(0))])
            for p, q in zip(points, repeated, strict=True)
        ]
        torch.testing.assert_close(found, torch.stack(slow), atol=1e-5, rtol=1e-4)
        near = 0.2 * points
        shifted = factors.look_up(near + 0.4, made), factors.look_up(near, made)
    torch.testing.assert_close(shifted[0][:, 5:], shifted[1][:, 5:], atol=1e-4, rtol=1e-3)
    assert not torch.allclose(shifted[0][:, :5], shifted[1][:, :5], atol=1e-2)


@pytest.mark.parametrize("resolution", [2, 5])
def test_tensors_are_as_fine_as_said(resolution):
    plane = PlaneDecoder(8, 5, 4, draw())(torch.randn(1, 8, resolution, resolution, generator=draw()))
    assert plane.shape == (1, 5, 16 * resolution, 16 * resolution)
    for dimensions, fineness in ((1, 16), (3, 8)):
        noise = torch.randn(1, 8, *(resolution,) * dimensions, generator=draw())
        made = StackDecoder(dimensions, 8, 5, 4, draw())(noise)
        assert made.shape == (1, 5, *(fineness * resolution,) * dimensions)


@BOTH
def test_the_networks_alone_are_trained_and_all_of_each(build):
    factors = build()
    trained = {name for name, _ in factors.named_parameters()}
    assert not any("noise" in name for name in trained)
    assert all("noise" in name for name, _ in factors.named_buffers())
    # The second convolution of each block starts at zero, and so hides what is before it until the first step.
    optimiser = torch.optim.SGD(factors.parameters(), lr=0.1)
    for _ in range(2):
        optimiser.zero_grad()
        factors.look_up(cube(200), factors.make()).square().mean().backward()
        optimiser.step()
    idle = [name for name, p in factors.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []


@BOTH
def test_noise_and_weights_are_functions_of_the_seed(build):
    def drawn(seed, luck):
        torch.manual_seed(luck)
        return build(seed).state_dict()

    one, again, other = drawn(0, 1), drawn(0, 2), drawn(3, 1)
    assert all(torch.equal(one[k], again[k]) for k in one)
    assert any(not torch.equal(one[k], other[k]) for k in one if "noise" in k)
    assert any(not torch.equal(one[k], other[k]) for k in one if k.endswith("weight"))


@BOTH
def test_what_is_made_is_the_same_however_often(build):
    factors = build()
    with torch.no_grad():
        assert all(torch.equal(a, b) for a, b in zip(factors.make(), factors.make(), strict=True))
