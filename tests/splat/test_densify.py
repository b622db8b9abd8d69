"""Densification's pure functions against slow twins."""

import math

import pytest
import torch

from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.splat.densify import Measured, initial_log_scales, split_children, stray_gaussians


def cloud(n: int = 40, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def test_initial_scale_is_the_root_mean_squared_distance_to_three_neighbours():
    means = cloud()
    squared = torch.cdist(means.double(), means.double()).square()
    nearest = squared.sort(dim=1).values[:, 1:4].mean(1)
    expected = 0.5 * nearest.log()
    assert torch.allclose(initial_log_scales(means), expected.float()[:, None].expand(-1, 3), atol=1e-4)


def test_scales_of_one_or_two_gaussians_are_finite():
    for n in (1, 2):
        assert torch.isfinite(initial_log_scales(cloud(n))).all()


def test_stray_gaussians_agree_with_the_definition():
    means = torch.cat([cloud(60), torch.tensor([[30.0, 0, 0]])])
    count = math.isqrt(len(means))
    squared = torch.cdist(means.double(), means.double()).square().sort(dim=1).values[:, :count]
    for sigmas in (0.5, 1.0, 2.326):
        expected = squared.mean(1) >= squared.mean() + sigmas * squared.std()
        assert torch.equal(stray_gaussians(means, sigmas), expected)
        assert expected[-1]


def test_children_are_distributed_like_their_parent():
    n = 20_000
    log_scales = torch.tensor([0.5, 0.1, 0.02]).log()
    quaternion = torch.tensor([0.9, 0.1, -0.3, 0.2])
    parents = {
        "means": torch.tensor([1.0, 2.0, 3.0]).repeat(n, 1),
        "log_scales": log_scales.repeat(n, 1),
        "quaternions": quaternion.repeat(n, 1),
        "other": torch.arange(n).float(),
    }
    children = split_children(parents, torch.Generator().manual_seed(0))
    R = matrix_from_quaternion(quaternion)
    covariance = R @ log_scales.exp().square().diag() @ R.T
    assert torch.allclose(children["means"].mean(0), parents["means"][0], atol=0.02)
    assert torch.allclose(children["means"].T.cov(), covariance, atol=0.01)
    assert torch.allclose(children["log_scales"].exp(), parents["log_scales"].exp().repeat(2, 1) / 1.6)
    assert torch.equal(children["other"], parents["other"].repeat(2))


@pytest.mark.parametrize("unit", [1, 200, 53])
def test_measurements_are_those_of_torch_to_the_bit(unit):
    n, draw = 5000, torch.Generator().manual_seed(0)
    size = torch.rand(n, 1, generator=draw) ** 8
    gradient = torch.randn(n, 2, generator=draw) * size
    visible = torch.rand(n, generator=draw) < 0.7
    gradient[~visible] = torch.nan  # of what is not seen nothing counts
    radii = torch.randint(0, 40, (n, 2), generator=draw, dtype=torch.int32)
    means2d = torch.zeros(n, 2)
    means2d.grad = gradient
    info = {"means2d": means2d, "visible": visible, "radii": radii, "width": 201, "height": 77}
    fast = slow = Measured.nothing(n, torch.device("cpu"))
    for _ in range(3):
        fast = fast.after(info, unit)
        slow = slow.after_by_torch(gradient, visible, radii, (201 / 2, 77 / 2), unit)
    assert slow.gradient.any() and slow.radius.any()
    for name in Measured._fields:
        assert torch.equal(getattr(fast, name), getattr(slow, name)), name
