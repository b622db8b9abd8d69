"""The splats' schedule: when it acts, and that its measurements follow the Gaussians."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from visdom_plugin.methods.splats.configs import GsGoConfig
from visdom_plugin.methods.splats.strategy import LargestGaussian, Schedule, Strategy, every
from visdom_plugin.seeding import generator
from visdom_plugin.splat.model import GaussianSet

CPU = torch.device("cpu")
CONFIG = replace(
    GsGoConfig(), densify_from=3, densify_until=9, densify_every=2, densify_gradient=0.5, sh_every=4
)


def strategy_of(config=CONFIG, schedule=None, n=30):
    draw = torch.Generator().manual_seed(0)
    splats = GaussianSet(
        config, torch.rand(n, 3, generator=draw), torch.rand(n, 3, generator=draw), extent=1.0, device=CPU
    )
    schedule = Schedule(reset_opacity=range(0)) if schedule is None else schedule
    return Strategy(splats, schedule, lambda done: generator(0, "split", done))


def drawn(n, gradient=0.0, radius=1):
    """What a render says of n Gaussians in a picture of 4 x 2 pixels."""
    means2d = torch.zeros(n, 2, requires_grad=True)
    means2d.grad = torch.full((n, 2), float(gradient))
    radii = torch.full((n, 2), radius, dtype=torch.int32)
    return SimpleNamespace(
        info={"means2d": means2d, "radii": radii, "visible": radii[:, 0] > 0, "width": 4, "height": 2}
    )


def step(strategy, i, **shown):
    for p in strategy.splats.optimiser.parameters.values():
        p.grad = torch.zeros_like(p)
    strategy.after_backward(i, drawn(len(strategy.splats), **shown))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 60), st.integers(1, 9), st.integers(1, 80))
def test_densification_is_due_on_multiples_between_its_ends(start, until, n, done):
    config = replace(CONFIG, densify_from=start, densify_until=until, densify_every=n)
    due = start < done < until and done % n == 0
    assert (done in strategy_of(config, n=2).densify_steps) == due


@given(st.integers(0, 9), st.integers(0, 30), st.integers(1, 60), st.integers(1, 80))
def test_other_events_are_due_on_every_nth_step_from_the_first(n, first, until, done):
    assert (done in every(n, first, until)) == (n > 0 and first <= done < until and (done - first) % n == 0)


def test_harmonics_come_in_one_degree_after_the_other():
    assert [strategy_of().sh_degree(i) for i in (0, 3, 4, 7, 8, 100)] == [0, 0, 1, 1, 2, 2]


def test_gaussians_that_pull_grow_and_what_was_measured_is_forgotten():
    strategy = strategy_of()
    for i in range(3):
        step(strategy, i, gradient=1)
    assert len(strategy.splats) == 30 and float(strategy.state_dict()["stats.count"].sum()) == 90
    # (1, 1) pixel is (2, 1) in halves of the picture.
    assert strategy.state_dict()["stats.gradient"].tolist() == pytest.approx([3 * 5**0.5] * 30)
    step(strategy, 3, gradient=1)
    assert len(strategy.splats) > 30
    assert not any(
        strategy.state_dict()[f"stats.{name}"].any() for name in ("gradient", "count", "radius_px")
    )
    before = len(strategy.splats)
    step(strategy, 5, gradient=0)
    assert len(strategy.splats) == before


def test_large_gaussians_go_only_after_the_step_that_says_so():
    for start, left in ((3, 15), (4, 30), (None, 30)):
        assert left_of_large(LargestGaussian(10.0, 0.0, 5.0), start) == left


@pytest.mark.parametrize(("fewest", "left"), [(0, 20), (29, 20), (30, 30), (31, 30)])
def test_of_the_fewest_none_goes_for_being_faint(fewest, left):
    strategy = strategy_of(schedule=Schedule(reset_opacity=range(0), fewest=fewest))
    logits = strategy.splats.gaussians().opacity_logits.detach().clone()
    logits[:10] = -20
    strategy.splats.optimiser.overwrite("opacity_logits", logits)
    for i in range(5):
        step(strategy, i)
    assert len(strategy.splats) == left


def left_of_large(largest, start=3, radius=6, factor=1):
    """How many of 30 stay of which 15 have that radius, in a picture of 4 x 2 times a factor."""
    strategy = strategy_of(schedule=Schedule(range(0), prune_large_from=start, largest=largest))
    render = drawn(30)
    render.info["radii"][:15] = radius * factor
    render.info |= {"width": 4 * factor, "height": 2 * factor}
    for p in strategy.splats.optimiser.parameters.values():
        p.grad = torch.zeros_like(p)
    strategy.after_backward(3, render)
    return len(strategy.splats)


def test_how_large_is_too_large_follows_the_size_of_the_picture():
    for factor in (1, 2, 10):
        assert left_of_large(LargestGaussian(10.0, 1.49, None), factor=factor) == 15
        assert left_of_large(LargestGaussian(10.0, 1.51, None), factor=factor) == 30
    # In pixels it does not.
    assert left_of_large(LargestGaussian(10.0, 1.0, 7.0)) == 30
    assert left_of_large(LargestGaussian(10.0, 1.0, 7.0), factor=2) == 15


def test_losing_more_than_half_is_said_once_with_the_reasons(caplog):
    strategy = strategy_of()
    strategy.remove(torch.arange(30) < 15, "outside the hull")
    step(strategy, 0)
    assert caplog.text == ""
    strategy.remove(torch.arange(15) < 4, "far from their neighbours")
    step(strategy, 1)
    strategy.remove(torch.arange(11) < 5, "outside the hull")
    step(strategy, 2)
    (record,) = caplog.records
    said = "step 2: 11 of 30 Gaussians are left; removed so far: 15 outside the hull, 4 far from their neighbours"
    assert record.levelname == "WARNING" and said in record.getMessage()


def test_measurements_follow_their_gaussians_and_are_state():
    strategy = strategy_of()
    render = drawn(30)
    render.info["means2d"].grad = torch.arange(60.0).reshape(30, 2)
    for p in strategy.splats.optimiser.parameters.values():
        p.grad = torch.zeros_like(p)
    strategy.after_backward(0, render)
    before = strategy.state_dict()["stats.gradient"]
    gone = torch.arange(30) % 3 == 0
    strategy.remove(gone, "why")
    assert torch.equal(strategy.state_dict()["stats.gradient"], before[~gone])
    twin = strategy_of(n=7)
    twin.load_state_dict({k: v.clone() for k, v in strategy.state_dict().items()})
    assert twin.state_dict().keys() == strategy.state_dict().keys()
    assert all(torch.equal(v, twin.state_dict()[k]) for k, v in strategy.state_dict().items())
    for none in (None, torch.zeros(20, dtype=torch.bool), torch.ones(20, dtype=torch.bool)):
        strategy.remove(none, "why")
        assert len(strategy.splats) == 20


def test_opacities_fall_on_the_steps_of_the_schedule():
    strategy = strategy_of(schedule=Schedule(every(3, 2, 9)))
    lowered = []
    for i in range(12):
        with torch.no_grad():
            strategy.splats.optimiser.parameters["opacity_logits"].fill_(1.0)
        step(strategy, i)
        if float(strategy.splats.optimiser.parameters["opacity_logits"].detach().max()) < 0:
            lowered.append(i + 1)
    assert lowered == [2, 5, 8]
