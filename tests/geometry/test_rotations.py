"""Laws of rotations."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from visdom_plugin.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp


def random_rotation(seed: int, *shape: int) -> torch.Tensor:
    quaternion = torch.randn(*shape, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return matrix_from_quaternion(quaternion)


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_round_trip_over_a_batch(seed):
    R = random_rotation(seed, 3, 5)
    assert torch.allclose(matrix_from_quaternion(quaternion_from_matrix(R)), R, atol=1e-12)
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-7, math.pi / 2, math.pi - 1e-7, math.pi])
@pytest.mark.parametrize("axis", range(3))
def test_round_trip_at_the_edges(angle, axis):
    quaternion = torch.zeros(4, dtype=torch.float64)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    R = matrix_from_quaternion(quaternion)
    assert torch.allclose(matrix_from_quaternion(quaternion_from_matrix(R)), R, atol=1e-12)


def test_matrix_agrees_with_rotation_about_z():
    a = 0.3
    R = matrix_from_quaternion(torch.tensor([math.cos(a / 2), 0, 0, math.sin(a / 2)]))
    expected = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    assert torch.allclose(R, expected)


@given(st.integers(0, 2**31), st.floats(0, 1))
@settings(max_examples=50, deadline=None)
def test_slerp_has_constant_speed_and_its_ends(seed, t):
    A, B = random_rotation(seed, 2)

    def angle(X, Y):
        return float(torch.arccos(((X.mT @ Y).diagonal().sum() - 1).div(2).clamp(-1, 1)))

    assert torch.allclose(slerp(A, B, 0.0), A, atol=1e-12)
    assert torch.allclose(slerp(A, B, 1.0), B, atol=1e-9)
    assert math.isclose(angle(A, slerp(A, B, t)), t * angle(A, B), abs_tol=1e-6)


def test_slerp_of_equal_rotations_is_that_rotation():
    A = random_rotation(0)
    assert torch.allclose(slerp(A, A, 0.37), A, atol=1e-12)
