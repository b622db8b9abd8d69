"""Everything is a function of config, data and seed, however often a run is killed."""

from __future__ import annotations

import torch

from visdom_plugin.conformance.report import require
from visdom_plugin.conformance.subject import difference
from visdom_plugin.training.protocols import Method
from visdom_plugin.training.runs import checkpoints


def test_randomness_comes_from_seed_and_step_alone(subject):
    n = subject.short
    found = subject.run(subject.start(luck=5), 0, n, luck=5)
    changed = difference(subject.trained.states[n], found.states[n])
    require(
        not changed,
        f"other global random numbers, the same seed: {n} steps lead elsewhere: {changed}",
        Method,
        "draw from visdom_plugin.seeding.generator(seed, 'what for', step) and pass it as generator=; layers of "
        "torch.nn begin with global random numbers, too",
    )


def test_a_resumed_run_equals_the_uninterrupted_one(subject, tmp_path):
    n, trained = subject.length, subject.trained
    cut, end = n // 2, 3 * n // 4
    state = trained.states[cut]
    flat = all(
        isinstance(k, str) and isinstance(v, torch.Tensor) for k, v in trained.method.state_dict().items()
    )
    require(flat, "state_dict() holds something that is no tensor", Method.state_dict, "use torch.as_tensor")
    checkpoints.save(tmp_path, cut, state, {})
    method = subject.start()
    method.load_state_dict(checkpoints.load(tmp_path, cut).tensors)
    kept = difference(state, {k: v.detach() for k, v in method.state_dict().items()})
    require(
        not kept,
        f"load_state_dict() does not take over all that state_dict() gave: {kept}",
        Method.load_state_dict,
        "copy every tensor of the state; those that change in size are replaced",
    )
    changed = difference(trained.states[end], subject.run(method, cut, end).states[end])
    require(
        not changed,
        f"resumed after step {cut}, step {end} is another than without the interruption: {changed}",
        Method.state_dict,
        "put everything that lasts from step to step into the state: moments and counts of the optimiser, "
        "statistics, learning rates; or make it a function of the step",
    )
