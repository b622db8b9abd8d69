"""The second device refuses what CUDA refuses, and computes as the CPU does."""

import pytest
import torch

from tests.device import second_device as second


@pytest.fixture
def device():
    with second.second_device() as device:
        yield device


def test_values_and_gradients_are_the_cpus(device):
    x = torch.arange(12.0).reshape(3, 4)
    there = x.to(device).requires_grad_()
    loss = (there[1:] * 2).sum(-1).square().sum()
    loss.backward()
    here = x.clone().requires_grad_()
    (here[1:] * 2).sum(-1).square().sum().backward()
    assert loss.device == there.grad.device == device
    assert torch.equal(there.grad.cpu(), here.grad)


def test_changes_in_place_reach_what_shares_the_memory(device):
    x = torch.zeros(5, device=device)
    x[1:3].add_(2)
    x[x > 0] = 7
    assert x.cpu().tolist() == [0, 7, 7, 0, 0] and x.nonzero().device == device


@pytest.mark.parametrize(
    "wrong",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.cat([x, torch.ones(3)]),
        lambda x: torch.where(torch.ones(3, dtype=torch.bool), x, 0),
        lambda x: x.numpy(),
        lambda x: torch.rand(3, device=x.device, generator=torch.Generator()),
        lambda x: x.index_select(0, torch.tensor([0])),
    ],
)
def test_it_refuses_what_cuda_refuses(device, wrong):
    with pytest.raises((RuntimeError, TypeError)):
        wrong(torch.ones(3, device=device))


def test_numbers_of_the_cpu_and_its_indices_may_take_part(device):
    x = torch.ones(3, device=device)
    assert (x * torch.tensor(2.0)).cpu().tolist() == [2, 2, 2]
    assert x[torch.tensor([0, 2])].device == device
