"""The fields' optimiser is torch's Adam, whatever the size of its tensors, and goes on from its state."""

import torch

from visdom_plugin.nerf.optimiser import SMALL, FieldOptimiser

SHAPES = {"table": (SMALL // 2 + 5, 3), "first": (7, 3), "bias": (7,), "last": (1, 7)}


def _parameters():
    draw = torch.Generator().manual_seed(0)
    return {k: torch.nn.Parameter(torch.randn(shape, generator=draw)) for k, shape in SHAPES.items()}


def _mine(parameters):
    table, nets = {"table": parameters["table"]}, {k: p for k, p in parameters.items() if k != "table"}
    return FieldOptimiser([(table, 0.0), (nets, 0.1)], betas=(0.9, 0.99), eps=1e-15)


def _give_gradients(parameters, seed):
    draw = torch.Generator().manual_seed(seed)
    for p in parameters.values():
        p.grad = torch.randn(p.shape, generator=draw)


def test_large_and_small_tensors_move_as_by_torchs_adam():
    mine, theirs = _parameters(), _parameters()
    optimiser = _mine(mine)
    groups = [
        {"params": [theirs["table"]], "weight_decay": 0.0},
        {"params": [theirs[k] for k in ("first", "bias", "last")], "weight_decay": 0.1},
    ]
    adam = torch.optim.Adam(groups, lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for step in range(4):
        _give_gradients(mine, step)
        _give_gradients(theirs, step)
        optimiser.step(0.01)
        adam.step()
        for k in SHAPES:
            assert mine[k].shape == SHAPES[k] and mine[k].grad is None
            torch.testing.assert_close(mine[k], theirs[k])


def test_a_resumed_optimiser_goes_on_bit_for_bit_and_its_state_is_by_parameter():
    straight, resumed = _parameters(), _parameters()
    one, other = _mine(straight), _mine(resumed)
    for step in range(3):
        _give_gradients(straight, step)
        one.step(0.01)
    state = {k: v.clone() for k, v in one.state_dict().items()}
    assert {k: tuple(state[f"adam.{k}.exp_avg"].shape) for k in SHAPES} == SHAPES
    assert all(state[f"adam.{k}.step"] == 3 for k in SHAPES)
    other.load_state_dict(state)
    for step in range(3, 5):
        for optimiser, parameters in ((one, straight), (other, resumed)):
            _give_gradients(parameters, step)
            optimiser.step(0.01)
    assert all(torch.equal(v, other.state_dict()[k]) for k, v in one.state_dict().items())


def test_a_small_parameter_without_a_gradient_counts_as_one_of_0():
    with_zero, without = _parameters(), _parameters()
    for parameters in (with_zero, without):
        optimiser = _mine(parameters)
        _give_gradients(parameters, 0)
        parameters["bias"].grad = torch.zeros(7) if parameters is with_zero else None
        optimiser.step(0.01)
    assert all(torch.equal(with_zero[k], without[k]) for k in SHAPES)


def test_a_state_from_before_any_step_has_no_moments():
    parameters = _parameters()
    optimiser = _mine(parameters)
    assert optimiser.state_dict().keys() == SHAPES.keys()
    optimiser.load_state_dict(_mine(_parameters()).state_dict())
    assert not optimiser.adam.state


def test_the_number_of_threads_changes_no_bit():
    moved, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            parameters = _parameters()
            optimiser = _mine(parameters)
            for step in range(3):
                _give_gradients(parameters, step)
                optimiser.step(0.01)
            moved.append(parameters)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(moved[0][k], moved[1][k]) for k in SHAPES)
