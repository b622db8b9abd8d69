"""A run's directory, its end, its interruptions, and whom it belongs to."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import pytest
import torch

from tests.training.fake import FakeConfig, FakeInner, FakeManager, FakeMethod, tiny_views
from visdom_plugin.errors import CheckpointError, EmptyHullError, PluginError
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training import metrics
from visdom_plugin.training.run import Interrupted
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.trainer import TrainingError

ROOT = Path(__file__).resolve().parents[2]


def _state(run_dir: Path) -> dict[str, torch.Tensor]:
    return checkpoints.load_newest(run_dir / "checkpoints").tensors


def _same(a, b) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def _log(run_dir: Path) -> list[dict]:
    return [json.loads(line) for line in (run_dir / "log.jsonl").read_text().splitlines()]


def test_a_run_leaves_what_the_design_lists(train, tmp_path):
    record = train()
    run = tmp_path / "run"
    assert json.loads((run / "run.json").read_text()) == {
        k: v for k, v in record.items() if k not in ("resumed_from", "already_finished")
    }
    assert {
        "schema",
        "status",
        "method",
        "scene",
        "seed",
        "config",
        "data",
        "versions",
        "device",
        "timing",
    } < set(record)
    assert (record["status"], record["method"], record["scene"], record["device"]) == (
        "finished",
        "fake",
        "ball",
        "cpu",
    )
    assert record["data"]["train"] == [f"train_{i}.png" for i in range(4)]
    assert {"root", "layout", "downscale", "test", "hashes"} < set(record["data"])
    assert set(record["timing"]) == {"hull_s", "train_s", "eval_s", "step_ms"}
    assert set(record["metrics"]["test"]) == set(metrics.NAMES)
    assert list(record["metrics"]["per_view"]) == [f"test_{i}.png" for i in range(3)]
    for name in metrics.NAMES[:-1]:
        assert isinstance(record["metrics"]["test"][name], float), name
    assert record["metrics"]["test"]["lpips"] is None
    assert sorted(p.name for p in (run / "renders" / "test").iterdir()) == [f"test_{i}.png" for i in range(3)]
    picture = cv2.imread(str(run / "renders" / "test" / "test_0.png"))
    assert picture.shape == (20, 24, 3) and (picture[0, 0] == 255).all()
    assert cv2.imread(str(run / "renders" / "test_sheet.png")).shape[1] > 3 * 200
    assert (run / "export" / "colours.txt").exists()
    assert [row["step"] for row in _log(run)] == list(range(1, 41))
    assert not list(run.rglob(".part-*"))


def test_the_same_command_on_a_finished_run_does_nothing(train, tmp_path):
    first = train()
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "run").rglob("*") if p.name != "run.lock"}
    again = train()
    assert again["already_finished"] and again["metrics"] == first["metrics"]
    assert before == {p: p.stat().st_mtime_ns for p in before}


@dataclass(frozen=True)
class SpyHull:
    """A hull setting that notes what it is carved from."""

    seen: tuple = ()

    def carve(self, cameras, masks):
        return SpyHullGrid(cameras, list(masks))


class SpyHullGrid:
    def __init__(self, cameras, masks):
        self.total = float(cameras.centres.sum()) + sum(float(m.sum()) for m in masks)
        self.n = len(masks)

    def save(self, path):
        Path(path).write_text(repr(self.total))

    def write_ply(self, path):
        Path(path).write_text(f"ply {self.total!r}")


def test_test_views_reach_neither_training_nor_hull(train, tmp_path, scene):
    other_test = tiny_views(5, 77, "else_", (30, 22))
    flipped = Views(
        other_test.cameras,
        [255 - image for image in other_test.images],
        [~mask for mask in other_test.masks],
        other_test.names,
    )
    config = FakeConfig(hull=SpyHull())
    train(config, run_dir=tmp_path / "a")
    train(config, run_dir=tmp_path / "b", scene=replace(scene, test=flipped))
    assert _same(_state(tmp_path / "a"), _state(tmp_path / "b"))
    for name in ("hull/hull.npz", "hull/hull.ply", "export/colours.txt"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    strip = [[{k: v for k, v in row.items() if k != "train_s"} for row in _log(tmp_path / n)] for n in "ab"]
    assert strip[0] == strip[1]
    # The comparison can fail: one changed training pixel changes the state.
    images = [image.clone() for image in scene.train.images]
    images[0][10, 12] = 255 - images[0][10, 12]
    assert bool(scene.train.masks[0][10, 12])
    train(config, run_dir=tmp_path / "c", scene=replace(scene, train=replace(scene.train, images=images)))
    assert not _same(_state(tmp_path / "a"), _state(tmp_path / "c"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"config": FakeConfig(inner=FakeInner(weight=0.75))}, r"config\.inner\.weight: 0\.5 -> 0\.75"),
        ({"config": FakeConfig(steps=41)}, r"config\.steps: 40 -> 41"),
        ({"seed": 1}, "seed: 0 -> 1"),
        ({"request": {"downscale": 2.0}}, r"data\.downscale: 1 -> 2\.0"),
        ({"scene": "pixel"}, r"data\.hashes\.train_views: "),
        ({"scene": "pose"}, r"data\.hashes\.test_views: "),
    ],
)
def test_a_directory_of_another_run_is_refused_and_stays_as_it_is(train, tmp_path, scene, change, says):
    train()
    before = {
        p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file() and p.name != "run.lock"
    }
    if change.get("scene") == "pixel":
        scene.train.images[2][3, 4, 1] ^= 1
        change = {"scene": scene}
    elif change.get("scene") == "pose":
        change = {"scene": replace(scene, test=tiny_views(3, 30.01, "test_"))}
    change = dict(change)
    config = change.pop("config", None)
    with pytest.raises(CheckpointError, match=says) as caught:
        train(config, **change)
    assert "--out" in caught.value.todo and "--overwrite" in caught.value.todo
    assert before == {p: p.read_bytes() for p in before}
    record = train(config, overwrite=True, **change)
    assert record["status"] == "finished" and not record["already_finished"]


def test_moved_data_is_the_same_data(train, scene):
    train(request={"path": "/somewhere"})
    assert train(request={"path": "/elsewhere"})["already_finished"]
    source = scene.source | {"root": "renamed", "split": "by hand"}
    renamed = replace(scene, name="renamed", source=source)
    assert train(scene=renamed, request={"train_list": "/gone.txt"})["already_finished"]


def test_a_folder_that_is_no_run_is_never_touched(train, tmp_path):
    precious = tmp_path / "run" / "thesis.tex"
    precious.parent.mkdir()
    precious.write_text("x")
    for overwrite in (False, True):
        with pytest.raises(CheckpointError, match=r"thesis\.tex"):
            train(overwrite=overwrite)
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["thesis.tex"]
    with pytest.raises(CheckpointError, match="is a file"):
        train(run_dir=precious)


def test_a_damaged_run_json_is_said(train, tmp_path):
    train()
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text()[:50])
    with pytest.raises(CheckpointError, match=r"run\.json cannot be read"):
        train()
    assert train(overwrite=True)["status"] == "finished"


def test_a_loss_that_is_not_finite_marks_the_run_failed_and_keeps_the_last_good_state(train, tmp_path):
    with pytest.raises(TrainingError, match="at step 7"):
        train(FakeConfig(nan_at=7), checkpoint_seconds=0)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["status"] == "failed" and "TrainingError" in record["error"]
    found = checkpoints.load_newest(tmp_path / "run" / "checkpoints")
    assert found.step == 7 and all(bool(v.isfinite().all()) for v in found.tensors.values())


def test_a_mistake_found_before_the_first_step_leaves_no_trace(train, tmp_path, monkeypatch):
    def empty(self, cameras, masks):
        raise EmptyHullError("no voxel")

    with monkeypatch.context() as patch, pytest.raises(EmptyHullError):
        patch.setattr(SpyHull, "carve", empty)
        train(FakeConfig(hull=SpyHull()))
    assert not (tmp_path / "run").exists()
    train()
    with monkeypatch.context() as patch, pytest.raises(EmptyHullError):
        patch.setattr(SpyHull, "carve", empty)
        train(FakeConfig(hull=SpyHull()), overwrite=True)
    assert not list((tmp_path / "run").glob("checkpoints/*"))


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
    assert _same(_state(run), _state(tmp_path / "whole"))
    assert [row["step"] for row in _log(run)] == list(range(1, 41))


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
    assert "cut short: it goes on" in caplog.text and _same(
        _state(tmp_path / "run"), _state(tmp_path / "whole")
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
    assert _same(_state(run), _state(tmp_path / "whole"))
    assert [row["step"] for row in _log(run)] == list(range(1, 41))


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
    assert _same(_state(run), _state(tmp_path / "whole"))
    assert [row["step"] for row in _log(run)] == [row["step"] for row in _log(tmp_path / "whole")]
    assert not list(run.rglob(".part-*"))


def test_two_processes_do_not_write_into_one_run(train, tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "tests.training.fake", str(run), "100000"]
    child = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    try:
        deadline = time.monotonic() + 60
        while not (run / "run.json").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        with pytest.raises(CheckpointError, match=f"another process .*process {child.pid}"):
            train()
    finally:
        child.kill()
        child.wait()


def test_hooks_are_built_from_the_hull_and_the_training_views_only_when_enabled(monkeypatch, scene):
    from visdom_plugin.registry import Preset
    from visdom_plugin.training.run import build

    built = []

    @dataclass(frozen=True)
    class Switch:
        enabled: bool

        def build(self, hull, views):
            built.append((hull, views))
            return "hook"

    @dataclass(frozen=True)
    class Config(FakeConfig):
        vd: Switch = Switch(False)
        hull: SpyHull = SpyHull()

    preset = Preset("fake", "", "tests.training.fake:FakeMethod", None, None)
    for enabled in (False, True):
        config = Config(vd=Switch(enabled))
        method, hull, _ = build(preset, config, scene.train, device=torch.device("cpu"), seed=3)
        assert method.hooks == (["hook"] if enabled else []) and method.hull is hull and hull.n == 4
    assert len(built) == 1 and built[0][1] is scene.train


def test_progress_says_how_far_and_how_good_unless_quiet(train, tmp_path, capsys):
    train(run_dir=tmp_path / "a", quiet=False)
    err = capsys.readouterr().err
    assert "step 40/40" in err and "loss 0." in err and "train PSNR" in err and "s left" in err
    train(run_dir=tmp_path / "b")
    out = capsys.readouterr()
    assert out.err == out.out == ""


def test_a_method_may_bring_its_own_training_psnr(train, tmp_path, monkeypatch):
    step_of = FakeMethod.train_step

    def measured_step(self, batch, step):
        return replace(step_of(self, batch, step), metrics={"psnr": torch.tensor(12.5)})

    monkeypatch.setattr(FakeMethod, "train_step", measured_step)
    train()
    assert {row["psnr"] for row in _log(tmp_path / "run")} == {12.5}


def test_a_method_that_returns_bare_losses_is_told_what_to_return(train, monkeypatch):
    step_of = FakeMethod.train_step
    monkeypatch.setattr(FakeMethod, "train_step", lambda *given: dict(step_of(*given).losses))
    with pytest.raises(PluginError, match="returned a dict, not a StepOutput") as refused:
        train()
    assert "FakeMethod" in str(refused.value.where)


def test_scenes_without_test_views_still_train(train, scene):
    empty = Views(scene.test.cameras[:0], [], [], [])
    record = train(scene=replace(scene, test=empty))
    assert record["status"] == "finished" and record["metrics"]["test"]["psnr"] is None


def test_the_manager_gets_training_views_seed_and_device(train, scene):
    seen = []

    class Manager(FakeManager):
        def __init__(self, views, seed, device):
            seen.append((views, seed, device))
            super().__init__(views, seed, device)

    train(data_manager=Manager, seed=5)
    assert seen == [(scene.train, 5, torch.device("cpu"))]


def test_the_scene_object_is_not_changed(train, scene):
    before = [image.clone() for image in scene.train.images]
    train()
    assert isinstance(scene, Scene) and all(map(torch.equal, before, scene.train.images))
