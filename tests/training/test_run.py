"""A training run: what it leaves, what it is handed, what it says."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import pytest
import torch

from tests.training.fake import FakeConfig, FakeManager, FakeMethod, log_of, same, state_of, tiny_views
from visdom_plugin.errors import EmptyHullError, PluginError
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training import metrics
from visdom_plugin.training.trainer import TrainingError


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
    assert [row["step"] for row in log_of(run)] == list(range(1, 41))
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

    def carve(self, cameras, masks, ignore=()):
        return SpyHullGrid(cameras, list(masks))


class SpyHullGrid:
    inner = None

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
    assert same(state_of(tmp_path / "a"), state_of(tmp_path / "b"))
    for name in ("hull/hull.npz", "hull/hull.ply", "export/colours.txt"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    strip = [[{k: v for k, v in row.items() if k != "train_s"} for row in log_of(tmp_path / n)] for n in "ab"]
    assert strip[0] == strip[1]
    # The comparison can fail: one changed training pixel changes the state.
    images = [image.clone() for image in scene.train.images]
    images[0][10, 12] = 255 - images[0][10, 12]
    assert bool(scene.train.masks[0][10, 12])
    train(config, run_dir=tmp_path / "c", scene=replace(scene, train=replace(scene.train, images=images)))
    assert not same(state_of(tmp_path / "a"), state_of(tmp_path / "c"))


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
    assert {row["psnr"] for row in log_of(tmp_path / "run")} == {12.5}


def test_a_method_that_returns_bare_losses_is_told_what_to_return(train, monkeypatch):
    step_of = FakeMethod.train_step
    monkeypatch.setattr(FakeMethod, "train_step", lambda *given: dict(step_of(*given).losses))
    with pytest.raises(PluginError, match="returned a dict, not a StepOutput") as refused:
        train()
    assert "FakeMethod" in str(refused.value.where)


def test_a_method_whose_export_names_no_files_is_told_what_to_return(train, tmp_path, monkeypatch):
    monkeypatch.setattr(FakeMethod, "export", lambda self, folder: None)
    with pytest.raises(PluginError, match="returned a NoneType, not the list") as refused:
        train()
    assert "FakeMethod" in str(refused.value.where) and not list((tmp_path / "run").rglob(".part-*"))


def test_scenes_without_test_views_still_train_and_show_pictures(train, scene, tmp_path):
    empty = Views(scene.test.cameras[:0], [], [], [])
    record = train(scene=replace(scene, test=empty))
    assert record["status"] == "finished" and record["metrics"]["test"]["psnr"] is None
    folder = tmp_path / "run" / "renders"
    assert sorted(p.name for p in folder.iterdir()) == ["orbit_sheet.png", "training_sheet.png"]
    sheets = {name: cv2.imread(str(folder / f"{name}_sheet.png")) for name in ("training", "orbit")}
    # Three rows of four views with the photographs, two of the four sides.
    assert sheets["training"].shape[1] == sheets["orbit"].shape[1]
    assert sheets["training"].shape[0] > 1.3 * sheets["orbit"].shape[0]
    assert not (tmp_path / "run" / "hull" / "reference.npz").exists()


def test_a_model_that_is_empty_in_a_training_view_fails(train, tmp_path, monkeypatch, scene):
    drawn = FakeMethod.render

    def render(self, camera, background):
        shown = drawn(self, camera, background)
        gone = torch.equal(camera.world_from_camera, scene.train.cameras[2].world_from_camera)
        return replace(shown, alpha=shown.alpha * 0.003) if gone else shown

    monkeypatch.setattr(FakeMethod, "render", render)
    with pytest.raises(TrainingError, match=f"nothing is drawn in training view {scene.train.names[2]}"):
        train()
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["status"] == "failed" and (tmp_path / "run" / "export").exists()


def test_evaluation_says_its_size_and_how_far_it_is(train, capsys, caplog, scene):
    with caplog.at_level("INFO", "visdom_plugin"):
        train(quiet=False)
    size = f"{int(scene.test.cameras.width[0])} x {int(scene.test.cameras.height[0])}"
    assert f"evaluation: {len(scene.test)} test views of {size} pixels" in caplog.text
    assert caplog.text.index("carving the reference hull") < caplog.text.index("evaluation:")
    n = len(scene.test)
    assert f"test view {n}/{n}  0 s left" in capsys.readouterr().err


def test_numbers_of_the_model_are_shown_and_kept(train, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(FakeMethod, "summary", lambda self: {"gaussians": 12345}, raising=False)
    record = train(quiet=False)
    assert record["model"] == {"gaussians": 12345} and "12,345 Gaussians" in capsys.readouterr().err
    assert {row["gaussians"] for row in log_of(tmp_path / "run")} == {12345}


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


def test_a_mistake_found_before_the_first_step_leaves_no_trace(train, tmp_path, monkeypatch):
    def empty(self, cameras, masks, ignore=()):
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
