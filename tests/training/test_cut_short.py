"""Runs that diverge, are stopped or killed, or find a damaged checkpoint: the same command goes on."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.training.fake import FakeConfig, FakeMethod, log_of, same, state_of
from visdom_plugin.training.run import Interrupted
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.trainer import TrainingError

ROOT = Path(__file__).resolve().parents[2]


def test_a_loss_that_is_not_finite_marks_the_run_failed_and_keeps_the_last_good_state(train, tmp_path):
    with pytest.raises(TrainingError, match="at step 7"):
        train(FakeConfig(nan_at=7), checkpoint_seconds=0)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["status"] == "failed" and "TrainingError" in record["error"]
    found = checkpoints.load_newest(tmp_path / "run" / "checkpoints")
    assert found.step == 7 and all(bool(v.isfinite().all()) for v in found.tensors.values())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_step_saves_and_the_same_command_goes_on(
    train, tmp_path, monkeypatch, caplog, number
):
    whole = train(run_dir=tmp_path / "whole")
    step_of = FakeMethod.train_step

    def interrupted_step(self, batch, step):
        if step == 17:
            os.kill(os.getpid(), number)
        return step_of(self, batch, step)

    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(FakeMethod, "train_step", interrupted_step)
        train()
    assert handlers == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    run = tmp_path / "run"
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert checkpoints.list_steps(run / "checkpoints") == [18]
    noted = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(noted | {"threads": 99}))
    record = train()
    assert f"threads: 99 -> {torch.get_num_threads()}" in caplog.text
    assert record["resumed_from"] == 18 and record["metrics"] == whole["metrics"]
    assert same(state_of(run), state_of(tmp_path / "whole"))
    assert [row["step"] for row in log_of(run)] == list(range(1, 41))


@pytest.mark.parametrize("status", ["interrupted", "running"])
def test_overwriting_a_run_cut_short_goes_on_with_it_and_no_other(
    train, tmp_path, monkeypatch, caplog, status
):
    """The same command resumes, with --overwrite as without."""
    caplog.set_level("INFO")
    whole = train(run_dir=tmp_path / "whole")
    step_of = FakeMethod.train_step

    def interrupted_step(self, batch, step):
        if step == 17:
            signal.raise_signal(signal.SIGINT)
        return step_of(self, batch, step)

    def cut_short():
        with monkeypatch.context() as patch, pytest.raises(Interrupted):
            patch.setattr(FakeMethod, "train_step", interrupted_step)
            train(overwrite=True)
        path = tmp_path / "run" / "run.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"status": status}))

    cut_short()
    record = train(overwrite=True)
    assert record["resumed_from"] == 18 and record["metrics"] == whole["metrics"]
    assert "cut short: it goes on" in caplog.text and same(
        state_of(tmp_path / "run"), state_of(tmp_path / "whole")
    )
    # A finished one is thrown away, and so are one cut short of other settings, and one that failed.
    assert train(overwrite=True)["resumed_from"] is None
    train(seed=1, overwrite=True)
    cut_short()
    assert train(FakeConfig(steps=30), overwrite=True)["resumed_from"] is None
    with pytest.raises(TrainingError):
        train(FakeConfig(nan_at=7), checkpoint_seconds=0, overwrite=True)
    with pytest.raises(TrainingError):
        train(FakeConfig(nan_at=7), checkpoint_seconds=1e9, overwrite=True)
    assert not checkpoints.list_steps(tmp_path / "run" / "checkpoints")


def test_a_damaged_last_checkpoint_costs_steps_but_not_the_result(train, tmp_path, monkeypatch, caplog):
    train(run_dir=tmp_path / "whole")
    run = tmp_path / "run"
    step_of = FakeMethod.optimise

    def failing_step(self, step, output):
        return 1 / 0 if step == 20 else step_of(self, step, output)

    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(FakeMethod, "optimise", failing_step)
        train(checkpoint_seconds=0)
    assert json.loads((run / "run.json").read_text())["status"] == "failed"
    newest = run / "checkpoints" / "step-00000020.safetensors"
    newest.write_bytes(newest.read_bytes()[:100])
    assert train()["status"] == "finished"
    assert "an older checkpoint is used" in caplog.text
    assert same(state_of(run), state_of(tmp_path / "whole"))
    assert [row["step"] for row in log_of(run)] == list(range(1, 41))


def test_killed_at_random_moments_a_run_ends_as_if_nothing_had_happened(train, tmp_path, scene):
    steps, run = 250, tmp_path / "run"
    train(FakeConfig(steps=steps, pause_s=0.004), run_dir=tmp_path / "whole", checkpoint_seconds=1e9)
    draw = random.Random(time.time_ns())
    command = [sys.executable, "-m", "tests.training.fake", str(run), str(steps)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    kills = 0
    for _ in range(2):
        child = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE)
        seen = checkpoints.list_steps(run / "checkpoints")
        while child.poll() is None and checkpoints.list_steps(run / "checkpoints") == seen:
            time.sleep(0.002)
        time.sleep(draw.uniform(0, 0.25))
        child.kill()
        kills += child.wait() == -signal.SIGKILL
        child.stderr.close()
    assert kills == 2
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads((run / "run.json").read_text())["status"] == "finished"
    assert same(state_of(run), state_of(tmp_path / "whole"))
    assert [row["step"] for row in log_of(run)] == [row["step"] for row in log_of(tmp_path / "whole")]
    assert not list(run.rglob(".part-*"))
