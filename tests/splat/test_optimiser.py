"""Adding and removing Gaussians leaves every other Gaussian, and its Adam state, as it was."""

import torch

from visdom_plugin.splat.optimiser import GaussianOptimiser

RATES = {"means": 0.1, "opacity_logits": 0.01}


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
