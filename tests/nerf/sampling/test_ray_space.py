"""Warped distances, contraction, hexagonal samples and encoded directions."""

import math

import numpy as np
import pytest
import torch

from visdom_plugin.nerf.encoding import view_directions
from visdom_plugin.nerf.sampling import contraction, multisampling, ray_warp


def _units(count: int, seed: int = 0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)


def _inverse_power_ladder(y, power, premultiplier=1.0):
    scale = abs(power - 1)
    return ((y * (power / scale) + 1) ** (1 / power) - 1) * (scale / premultiplier)


def _normalise_distances(t, near, far, power=ray_warp.POWER):
    """The published warp, the inverse of `distances_of`."""
    low, high, value = (x if power == 1 else ray_warp.power_ladder(x, power, 2.0) for x in (near, far, t))
    return (value - low) / (high - low)


def _uncontract(points):
    norm = points.norm(dim=-1, keepdim=True).clamp_min(1)
    return points / (norm * (2 - norm))


@pytest.mark.parametrize("power,premultiplier", [(-1.5, 2.0), (-0.25, 1e4), (0.5, 1.0), (2.0, 3.0)])
def test_the_power_ladder_has_its_inverse_and_starts_with_its_multiplier(power, premultiplier):
    x = torch.logspace(-4, 2, 50).double()
    y = ray_warp.power_ladder(x, power, premultiplier)
    assert (y.diff() > 0).all()
    torch.testing.assert_close(_inverse_power_ladder(y, power, premultiplier), x)
    tiny = torch.tensor(1e-9).double()
    torch.testing.assert_close(
        ray_warp.power_ladder(tiny, power, premultiplier), premultiplier * tiny, rtol=1e-4, atol=0
    )


@pytest.mark.parametrize("power", [-1.5, 1.0])
@pytest.mark.parametrize("far", [6.0, 1e6])
def test_distances_and_their_normalised_form(power, far):
    near, far = torch.tensor([[0.0], [0.2], [2.0]]).double(), torch.tensor(far).double()
    s = torch.linspace(0, 1, 101).double().expand(3, -1)
    t = ray_warp.distances_of(s, near, far, power)
    assert (t.diff(dim=-1) > 0).all()
    torch.testing.assert_close(t[:, 0], near[:, 0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(t[:, -1], far.expand(3), rtol=1e-9, atol=0)
    torch.testing.assert_close(_normalise_distances(t, near, far, power), s, rtol=1e-9, atol=1e-9)
    single = ray_warp.distances_of(s.float(), near.float(), far.float(), power)
    assert (single.diff(dim=-1) > 0).all()
    assert torch.equal(single[:, -1], far.float().expand(3)) or power != 1.0


def test_contraction_is_continuous_bounded_and_invertible():
    unit = _units(200)
    near = [contraction.contract(unit * r) for r in (1 - 1e-9, 1 + 1e-9)]
    torch.testing.assert_close(near[0], near[1], rtol=0, atol=1e-8)
    radius = torch.logspace(-2, 4, 200).double()[:, None]
    contracted = contraction.contract(unit * radius)
    assert (contracted.norm(dim=-1) < 2).all()
    torch.testing.assert_close(_uncontract(contracted), unit * radius)
    inside = unit * 0.9
    assert torch.equal(contraction.contract(inside), inside)


def test_contracted_scale_is_the_root_of_the_jacobians_determinant():
    points = _units(40) * torch.logspace(-0.5, 2, 40).double()[:, None]
    jacobian = torch.stack([torch.autograd.functional.jacobian(contraction.contract, p) for p in points])
    _, scale = contraction.contract(points, torch.ones(40).double())
    torch.testing.assert_close(scale, torch.linalg.det(jacobian).abs() ** (1 / 3))


def test_contraction_kernel_equals_torch():
    points = (_units(3000) * torch.logspace(-2, 6, 3000).double()[:, None]).reshape(30, 100, 3)
    std = torch.rand(30, 100).double()
    fast = contraction.contract(points.float(), std.float())
    for a, b in zip(fast, contraction._contract_torch(points, std), strict=True):
        torch.testing.assert_close(a.double(), b, rtol=2e-6, atol=0)
    kernel = contraction.contract(points.float(), std.float().requires_grad_())[1]
    assert kernel.requires_grad


def test_contraction_scales_and_shifts_what_comes_out():
    points, std = _units(300).float() * 3, torch.rand(300)
    plain, deviations = contraction.contract(points, std)
    for gradient in (False, True):  # the kernel, and torch
        unit, scaled = contraction.contract(
            points, std.clone().requires_grad_(gradient), scale=0.25, shift=0.5
        )
        tolerance = {"rtol": 2e-6, "atol": 1e-7} if gradient else {"rtol": 0, "atol": 0}
        torch.testing.assert_close(unit, plain * 0.25 + 0.5, **tolerance)
        torch.testing.assert_close(scaled.detach(), deviations * 0.25, **tolerance)


def _frustum_moments(t0, t1, radius):
    """Mean and variance along the axis, and variance across, of a uniformly filled cone between t0 and t1."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    t = 0.5 * (t0 + t1) + 0.5 * (t1 - t0) * nodes
    weights = weights * t**2  # the disc's area
    weights = weights / weights.sum()
    mean = (weights * t).sum()
    return mean, (weights * (t - mean) ** 2).sum(), (weights * (radius * t) ** 2).sum() / 4


@pytest.mark.parametrize("t0,t1", [(0.0, 1.0), (1.0, 1.01), (2.0, 6.0), (0.1, 900.0)])
@pytest.mark.parametrize("random", [False, True])
def test_hexagons_have_the_frustums_moments(t0, t1, random):
    """Mean, variance along and summed variance across are exact. Correlations between axes, which a cone does
    not have, stay under 0.22 for a section as long as its distance and under 0.003 for a short one."""
    radius = 0.01
    unit = _units(1)
    number = torch.rand(1, 1).double() if random else None
    points, std = multisampling.multisample(
        torch.zeros(1, 3).double(),
        unit,
        torch.tensor([[t0, t1]], dtype=torch.float64),
        torch.tensor(radius, dtype=torch.float64),
        number,
    )
    first, second = multisampling.axes_across(unit)
    local = points[0, 0] @ torch.cat([first, second, unit]).T
    mean, along, across = _frustum_moments(t0, t1, radius)
    # Six points as wide as a whole cone's reach a little past its base.
    assert (local[:, 2] >= t0).all() and (local[:, 2] <= t1 + 0.04 * (t1 - t0)).all()
    assert float(local[:, 2].mean()) == pytest.approx(mean, rel=1e-9)
    assert float(local[:, 2].var(correction=0)) == pytest.approx(along, rel=1e-6)
    torch.testing.assert_close(local[:, :2].mean(0), torch.zeros(2).double(), atol=1e-9 * t1, rtol=0)
    covariance = local.T.cov(correction=0)
    assert float(covariance[0, 0] + covariance[1, 1]) == pytest.approx(2 * across, rel=1e-6)
    scale = covariance.diagonal().sqrt()
    off = (covariance / (scale[:, None] * scale)).fill_diagonal_(0).abs()
    assert off.max() < (0.22 if t0 < 0.5 * t1 else 0.003)
    torch.testing.assert_close(std[0, 0], 0.5 * radius * local[:, 2] / math.sqrt(2))


def test_hexagons_by_the_published_formula():
    distances = torch.tensor([[0.5, 0.9, 2.0, 7.0]]).double()
    points, _ = multisampling.multisample(
        torch.zeros(1, 3).double(),
        torch.tensor([[0.0, 0, 1]]).double(),
        distances,
        torch.tensor(0.1).double(),
    )
    for i in range(3):
        t0, t1 = distances[0, i].item(), distances[0, i + 1].item()
        s, d = (t0 + t1) / 2, (t1 - t0) / 2
        for j, angle in enumerate([0, 2, 4, 3, 5, 1]):
            root = math.sqrt((d * d - s * s) ** 2 + 4 * s**4)
            t = t0 + d * (t1**2 + 2 * s * s + 3 / math.sqrt(7) * (2 * j / 5 - 1) * root) / (d * d + 3 * s * s)
            turn = angle * math.pi / 3 if i % 2 == 0 else math.pi / 6 - angle * math.pi / 3
            across = 0.1 * t / math.sqrt(2)
            expected = torch.tensor([across * math.cos(turn), across * math.sin(turn), t]).double()
            torch.testing.assert_close(points[0, i, j], expected)


@pytest.mark.parametrize("random", [False, True])
def test_hexagon_kernel_equals_torch(random):
    origins, unit = torch.randn(6, 5, 3).double(), _units(30).reshape(6, 5, 3)
    distances = torch.rand(6, 5, 9).double().cumsum(-1)
    radius = torch.rand(6, 5).double() * 0.1
    number = torch.rand(6, 5, 8) if random else None
    slow = multisampling.multisample(
        origins, unit, distances, radius, number if number is None else number.double()
    )
    fast = multisampling.multisample(origins.float(), unit.float(), distances.float(), radius.float(), number)
    for a, b in zip(fast, slow, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=2e-6)


def test_hexagons_of_nothing_and_of_everything_are_numbers():
    distances = torch.tensor([[0.0, 0.0, 1e10, 1e10]])
    for random in (None, torch.rand(1, 3)):
        out = multisampling.multisample(
            torch.zeros(1, 3), _units(1).float(), distances, torch.tensor(0.01), random
        )
        assert all(torch.isfinite(x).all() for x in out)


def test_frames_are_right_handed_rotations():
    unit = torch.cat([_units(100), torch.eye(3).double(), -torch.eye(3).double()])
    first, second = multisampling.axes_across(unit)
    frame = torch.stack([first, second, unit], -2)
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3).double().expand(106, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(106).double())


def test_harmonics_are_orthonormal():
    """By a product rule that integrates polynomials of degree 6 on the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    ring = np.sqrt(1 - z**2)
    grid = np.stack(
        [ring[:, None] * np.cos(angle), ring[:, None] * np.sin(angle), np.broadcast_to(z[:, None], (8, 16))],
        -1,
    )
    values = view_directions.encode_harmonics(torch.from_numpy(grid))
    measure = torch.from_numpy(weights)[:, None] * 2 * np.pi / 16
    gram = torch.einsum("abi,abj,ab->ij", values, values, measure.expand(8, 16))
    torch.testing.assert_close(gram, torch.eye(16).double())


def test_harmonics_on_any_device_are_the_kernels():
    unit = _units(500, dtype=torch.float32)
    torch.testing.assert_close(view_directions.encode_harmonics(unit), view_directions._harmonics_torch(unit))


def test_sinusoids_in_their_order():
    unit = _units(7)
    expected = torch.cat(
        [unit, *(torch.sin(unit * 2**k) for k in range(4)), *(torch.cos(unit * 2**k) for k in range(4))], -1
    )
    torch.testing.assert_close(view_directions.encode_sinusoids(unit), expected)
    # No octave leaves the direction itself.
    torch.testing.assert_close(view_directions.encode_sinusoids(unit, 0), unit)
