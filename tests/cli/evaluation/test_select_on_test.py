"""Snapshots, and what choosing among them by the test views is worth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.training import fake
from visdom_plugin import registry
from visdom_plugin.cli.commands import evaluate as command
from visdom_plugin.cli.commands import train as train_command
from visdom_plugin.cli.evaluation.select_on_test import select_on_test
from visdom_plugin.errors import CheckpointError, SceneError
from visdom_plugin.scene import Views
from visdom_plugin.training import run
from visdom_plugin.training.evaluate import evaluate
from visdom_plugin.training.runs import checkpoints

CPU = torch.device("cpu")


def states(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.safetensors"))}


def test_snapshots_are_the_states_on_the_way_and_change_nothing(train, tmp_path):
    plain = train(run_dir=tmp_path / "plain")
    kept = train(run_dir=tmp_path / "kept", snapshots=4)
    assert not (tmp_path / "plain" / "snapshots").exists()
    assert checkpoints.list_steps(tmp_path / "kept" / "snapshots") == [10, 20, 30, 40]
    assert plain["metrics"] == kept["metrics"]
    assert states(tmp_path / "plain" / "checkpoints") == states(tmp_path / "kept" / "checkpoints")
    shorter = train(fake.FakeConfig(steps=40), run_dir=tmp_path / "each", checkpoint_seconds=0, snapshots=40)
    assert shorter["metrics"] == plain["metrics"]
    each, few = (states(tmp_path / name / "snapshots") for name in ("each", "kept"))
    assert len(each) == 40 and few.items() <= each.items()


def test_more_snapshots_than_steps_are_one_a_step(train, tmp_path):
    train(fake.FakeConfig(steps=3), snapshots=10)
    assert checkpoints.list_steps(tmp_path / "run" / "snapshots") == [1, 2, 3]


@pytest.fixture
def scene():
    return fake.tiny_scene()


@pytest.fixture
def train(monkeypatch, tmp_path, scene):
    """train(config, ...) of the fake method into tmp_path / "run"."""
    monkeypatch.setattr(registry, "installed", fake.fake_registry)

    def call(config=None, **keywords):
        keywords = {"run_dir": tmp_path / "run", "quiet": True, "data_manager": fake.FakeManager} | keywords
        return run.train(fake.NAME, config or fake.FakeConfig(), scene, **keywords)

    return call


@pytest.fixture
def measured(train, scene, tmp_path):
    record = train(snapshots=8)
    method = fake.FakeMethod(fake.FakeConfig())
    method.setup(scene.train, [], hull=None, device=CPU, seed=0)
    return record, method


def test_the_best_is_the_maximum_of_what_each_snapshot_measures(measured, scene, tmp_path):
    record, method = measured
    chosen = select_on_test(method, scene.test, device=CPU, run_dir=tmp_path / "run")
    found = chosen["selected_on_test"]
    assert "test views" in found["warning"]
    by_step = {}
    for step in checkpoints.list_steps(tmp_path / "run" / "snapshots"):
        method.load_state_dict(checkpoints.load(tmp_path / "run" / "snapshots", step).tensors)
        by_step[step] = evaluate(method, scene.test, reference_hull=None, device=CPU)["test"]["psnr"]
    assert {int(s): m["psnr"] for s, m in found["by_step"].items()} == pytest.approx(by_step)
    assert len(set(by_step.values())) > 1
    assert found["step"] == max(by_step, key=by_step.get)
    assert max(by_step.values()) >= record["metrics"]["test"]["psnr"] == pytest.approx(by_step[40])
    # The headline stays what it was.
    assert chosen["metrics"] == record["metrics"]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["metrics"] == record["metrics"]


def test_without_snapshots_or_truth_there_is_nothing_to_choose(train, measured, scene, tmp_path):
    _, method = measured
    train(run_dir=tmp_path / "none")
    with pytest.raises(CheckpointError, match="kept no snapshots") as error:
        select_on_test(method, scene.test, device=CPU, run_dir=tmp_path / "none")
    assert "--snapshots 10" in error.value.todo
    unknown = Views(**{**vars(scene.test), "mask_origins": ("missing",) * len(scene.test)})
    with pytest.raises(SceneError, match="no test view"):
        select_on_test(method, unknown, device=CPU, run_dir=tmp_path / "run")


def test_overwriting_a_run_takes_its_snapshots_along(measured, train, tmp_path):
    train(fake.FakeConfig(steps=4), overwrite=True)
    assert not (tmp_path / "run" / "snapshots").exists()


def test_the_commands_keep_and_choose_and_say_what_it_is(train, tmp_path, monkeypatch, capsys):
    import datamodules

    monkeypatch.setattr(datamodules, "load", lambda *a, **b: fake.tiny_scene())
    monkeypatch.chdir(tmp_path)
    words = ["method:fake", "--out", "here", "--snapshots", "2", "--quiet", "--no-report"]
    assert train_command.main(words) == 0
    assert len(states(Path("here/snapshots"))) == 2
    before = json.loads(Path("here/run.json").read_text())["metrics"]["test"]
    assert command.main(["here", "--oracle"]) == 0
    shown = capsys.readouterr().out
    assert "SELECTED ON THE TEST SET, the best of 2 snapshots: not a result" in shown
    assert command.main(["here", "--oracle", "--quiet"]) == 0 and capsys.readouterr().out == ""
    after = json.loads(Path("here/run.json").read_text())
    assert after["metrics"]["test"] == before and after["selected_on_test"]["step"] in (20, 40)
    assert train_command.main(["method:fake", "--out", "other", "--snapshots", "-1"]) == 2
    assert "--snapshots -1 is out of range" in capsys.readouterr().err and not Path("other").exists()
