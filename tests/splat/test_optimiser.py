"""Adding and removing Gaussians leaves every other Gaussian, and its Adam state, as it was."""

import pytest
import torch

from visdom_plugin.splat.optimiser import EPSILON, GaussianOptimiser

RATES = {"means": 0.1, "opacity_logits": 0.01}
SHAPES = {"means": (3,), "quaternions": (4,), "opacity_logits": (), "sh": (9, 3)}
ALL_RATES = {"means": 1e-3, "quaternions": 2e-3, "opacity_logits": 5e-2, "sh": 2.5e-3}
PARTS = {"sh_dc": ("sh", slice(0, 1), 1), "sh_rest": ("sh", slice(1, None), 1 / 20)}
"""Harmonics as the state has them: of which parameter, which of them, and their share of its learning rate."""


def fresh(n: int = 6, seed: int = 0) -> GaussianOptimiser:
    g = torch.Generator().manual_seed(seed)
    return GaussianOptimiser(
        {"means": torch.randn(n, 3, generator=g), "opacity_logits": torch.randn(n, generator=g)}, RATES
    )


def pull(optimiser: GaussianOptimiser, steps: int) -> None:
    """Gradient descent on sum(p^2 * (1 + row)): rows do not influence each other."""
    for _ in range(steps):
        loss = sum((p**2).sum() for p in optimiser.parameters.values())
        loss.backward()
        optimiser.step()


def test_kept_gaussians_continue_as_if_nothing_happened():
    alone, together = fresh(), fresh()
    kept = torch.tensor([True, False, True, True, False, True])
    pull(alone, 3)
    pull(together, 3)
    together.keep(kept)
    pull(alone, 4)
    pull(together, 4)
    for name in RATES:
        # A row's place in a SIMD register decides the last bit.
        torch.testing.assert_close(
            together.parameters[name].data, alone.parameters[name][kept].data, rtol=1e-6, atol=1e-7
        )


def test_appended_gaussians_start_with_empty_moments_and_leave_the_others_alone():
    alone, together = fresh(), fresh()
    pull(alone, 3)
    pull(together, 3)
    together.append({"means": torch.ones(2, 3), "opacity_logits": torch.ones(2)})
    state = together.state_dict()
    assert (state["adam.means.exp_avg"][6:] == 0).all() and (state["adam.means.exp_avg"][:6] != 0).any()
    pull(alone, 4)
    pull(together, 4)
    assert len(together) == 8
    for name in RATES:
        torch.testing.assert_close(
            together.parameters[name][:6].data, alone.parameters[name].data, rtol=1e-6, atol=1e-7
        )


def test_overwriting_forgets_the_moments_of_that_parameter_only():
    optimiser = fresh()
    pull(optimiser, 3)
    before = {k: v.clone() for k, v in optimiser.state_dict().items()}
    optimiser.overwrite("opacity_logits", torch.zeros(6))
    after = optimiser.state_dict()
    assert (after["opacity_logits"] == 0).all() and (after["adam.opacity_logits.exp_avg"] == 0).all()
    assert torch.equal(after["adam.means.exp_avg_sq"], before["adam.means.exp_avg_sq"])


def test_state_round_trip_continues_bit_for_bit_at_another_size():
    straight = fresh()
    pull(straight, 2)
    straight.keep(torch.tensor([True, True, False, True, True, True]))
    pull(straight, 2)
    saved = {k: v.clone() for k, v in straight.state_dict().items()}
    resumed = fresh(n=9, seed=5)
    resumed.load_state_dict(saved)
    pull(straight, 5)
    pull(resumed, 5)
    for name, value in straight.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name


def rows(n: int, seed: int, dtype=torch.float32) -> dict[str, torch.Tensor]:
    """Numbers for every parameter; gradients of single Gaussians are as small."""
    g = torch.Generator().manual_seed(seed)
    return {k: torch.randn(n, *shape, generator=g, dtype=dtype) for k, shape in SHAPES.items()}


def in_parts(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """As the state has them."""
    whole = {k: v for k, v in tensors.items() if k != "sh"}
    return whole | {part: tensors[of][:, which] for part, (of, which, _) in PARTS.items()}


def torch_adam(parameters: dict[str, torch.Tensor]) -> tuple[dict[str, torch.nn.Parameter], torch.optim.Adam]:
    """What version 0.1.0 trained Gaussians with: one tensor of torch's Adam for each part."""
    own = {k: torch.nn.Parameter(v.clone()) for k, v in in_parts(parameters).items()}
    rates = ALL_RATES | {part: ALL_RATES[of] * share for part, (of, _, share) in PARTS.items()}
    return own, torch.optim.Adam([{"params": [p], "lr": rates[k]} for k, p in own.items()], eps=EPSILON)


def train(optimiser: GaussianOptimiser, first: int, last: int) -> None:
    for step in range(first, last):
        for name, gradient in rows(len(optimiser), step).items():
            p = optimiser.parameters[name]
            p.grad = 1e-4 * gradient.to(p)
        optimiser.step()


def train_by_torch(own: dict[str, torch.nn.Parameter], adam: torch.optim.Adam, first: int, last: int) -> None:
    for step in range(first, last):
        for name, gradient in in_parts(rows(len(own["means"]), step)).items():
            own[name].grad = 1e-4 * gradient.to(own[name])
        adam.step()


# 777 Gaussians end within a block; in float64 torch calculates, as on other devices.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("n", [0, 1, 777])
def test_steps_are_those_of_torchs_adam(n, dtype, tolerance):
    optimiser = GaussianOptimiser(rows(n, 100, dtype), ALL_RATES)
    own, adam = torch_adam(rows(n, 100, dtype))
    train(optimiser, 0, 20)
    train_by_torch(own, adam, 0, 20)
    for name, value in own.items():
        state = optimiser.state_dict()
        torch.testing.assert_close(state[name], value.detach(), rtol=tolerance, atol=tolerance)
        for key in ("exp_avg", "exp_avg_sq"):
            wanted = adam.state[value][key]
            torch.testing.assert_close(state[f"adam.{name}.{key}"], wanted, rtol=10 * tolerance, atol=1e-11)


def test_steps_are_the_same_to_the_bit_for_any_number_of_threads():
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            optimiser = GaussianOptimiser(rows(3000, 100), ALL_RATES)
            train(optimiser, 0, 3)
            found.append(optimiser.state_dict())
    finally:
        torch.set_num_threads(before)
    for name, value in found[0].items():
        assert all(torch.equal(other[name], value) for other in found[1:]), name


def test_a_parameter_without_a_gradient_stays_and_its_steps_do_not_count():
    optimiser = GaussianOptimiser(rows(40, 100), ALL_RATES)
    optimiser.parameters["means"].grad = torch.ones(40, 3)
    optimiser.step()
    state = optimiser.state_dict()
    assert torch.equal(state["quaternions"], rows(40, 100)["quaternions"])
    assert [k for k in state if k.endswith(".step")] == ["adam.means.step"]


def test_a_parameter_that_was_given_other_memory_goes_on_there():
    straight, moved = (GaussianOptimiser(rows(40, 100), ALL_RATES) for _ in range(2))
    train(straight, 0, 2)
    train(moved, 0, 2)
    for parameter in moved.parameters.values():
        parameter.data = parameter.data.clone()
    train(straight, 2, 4)
    train(moved, 2, 4)
    for name, value in straight.state_dict().items():
        assert torch.equal(moved.state_dict()[name], value), name


def test_the_state_of_torchs_adam_is_taken_over():
    """Checkpoints that were written when it trained Gaussians go on."""
    own, adam = torch_adam(rows(50, 100))
    train_by_torch(own, adam, 0, 5)
    saved = {k: v.detach().clone() for k, v in own.items()}
    saved |= {f"adam.{k}.{key}": x.clone() for k, v in own.items() for key, x in adam.state[v].items()}
    optimiser = GaussianOptimiser(rows(20, 7), ALL_RATES)
    optimiser.load_state_dict(saved)
    assert set(optimiser.state_dict()) == set(saved)
    assert all(torch.equal(value, saved[name]) for name, value in optimiser.state_dict().items())
    train(optimiser, 5, 10)
    train_by_torch(own, adam, 5, 10)
    for name, value in own.items():
        torch.testing.assert_close(optimiser.state_dict()[name], value.detach(), rtol=1e-6, atol=1e-6)
