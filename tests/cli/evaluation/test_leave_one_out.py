"""visdom-eval --leave-one-out: the held-out view reaches nothing, and what is said of the views is true."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch

from datamodules.request import Request
from datamodules.views.splits import choose, every_eighth
from tests.training import fake
from visdom_plugin.cli.commands import evaluate
from visdom_plugin.cli.evaluation.leave_one_out import check_views, run_folds, summarise
from visdom_plugin.cli.options import Common
from visdom_plugin.errors import CheckpointError, ConfigError, EmptyHullError, PluginError, SceneError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.scene import hold_out
from visdom_plugin.training.missing_masks import fill_masks
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.trainer import TrainingError

WORDS = ["--leave-one-out", "method:fake", "--method.steps", "12", "--out", "loo"]
DOMAIN = VisibleDomain(resolution=24, k=2)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """The hull that renders are measured against is coarse here, too."""
    from visdom_plugin.training import evaluate, run

    carve = evaluate.carve_reference
    monkeypatch.setattr(run, "carve_reference", lambda views: carve(views, DOMAIN))


@pytest.fixture
def fold(fakes, monkeypatch):
    """fold(scene, folder, method, config): all runs of leave-one-out, and their summary."""
    from visdom_plugin import registry
    from visdom_plugin.cli import scenes

    monkeypatch.setattr(scenes, "make_data_manager", fake.FakeManager)

    def call(scene, folder, preset=fake.PRESET, config=None, **keywords):
        config = config or fake.FakeConfig(steps=12, hull=DOMAIN)
        missing = keywords.get("missing_masks", "error")
        common = Common(quiet=True, budget="quick", views=len(scene.train), missing_masks=missing)
        request = SimpleNamespace(preset=preset, config=config, common=common)
        return run_folds(request, scene, Path(folder), device="cpu")

    assert registry.find("fake") is fake.PRESET
    return call


def _poisoned(scene, index):
    """The scene with another picture, another mask and another place of one training view."""
    train = scene.train
    images, masks = list(train.images), list(train.masks)
    images[index], masks[index] = 255 - images[index], masks[index].roll(1, 0)
    motion = train.cameras.world_from_camera.clone()
    motion[index, :3, 3] += 0.05
    cameras = replace(train.cameras, world_from_camera=motion)
    return replace(scene, train=replace(train, cameras=cameras, images=images, masks=masks))


def _made(run: Path):
    """Everything a run makes but what is measured on its test view."""
    state = checkpoints.load_newest(run / "checkpoints").tensors
    # hull.npz holds seconds, too.
    files = {n: (run / n).read_bytes() for n in ("hull/hull.ply", "export/colours.txt")}
    rows = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return state, files, [{k: v for k, v in row.items() if k != "train_s"} for row in rows]


def _same(a, b):
    return all(torch.equal(value, b[0][name]) for name, value in a[0].items()) and a[1:] == b[1:]


def test_the_held_out_view_reaches_nothing(fold):
    scene = fake.tiny_scene()
    first = fold(scene, "a")
    for held in (0, 3):
        other = fold(_poisoned(scene, held), f"b{held}")
        for i, name in enumerate(scene.train.names):
            run = name.removesuffix(".png")
            same = _same(_made(Path("a") / run), _made(Path(f"b{held}") / run))
            assert same is (i == held), f"poison in view {held} seen by the run without view {i}: {not same}"
        name = scene.train.names[held]
        assert other["per_view"][name]["psnr"] != first["per_view"][name]["psnr"]


def test_nothing_of_a_real_method_knows_the_held_out_view():
    """Frame, bounds and start of Instant-NGP, from a capture whose held-out view was moved away and inverted."""
    from method_configs.ingp import SPEC
    from visdom_plugin.methods.fields.ingp import Ingp

    scene = fake.tiny_scene()
    config = replace(
        SPEC.quick, occupancy_resolution=16, hidden=8, grid=replace(SPEC.quick.grid, log2_table_size=8)
    )
    states = []
    for whole, index in ((scene, 2), (_poisoned(scene, 2), 2), (_poisoned(scene, 2), 1)):
        views = hold_out(whole, index).train
        hull = DOMAIN.carve(*views.silhouettes())
        method = Ingp(replace(config, hull=DOMAIN, vd=replace(config.vd, enabled=True)))
        method.setup(
            views, [method.config.vd.build(hull, views)], hull=hull, device=torch.device("cpu"), seed=0
        )
        states.append((method.frame.scale, *method.frame.centre.tolist(), method.occupancy.reachable))
    assert states[0][:4] == states[1][:4] and torch.equal(states[0][4], states[1][4])
    assert states[0][:4] != states[2][:4] and not torch.equal(states[0][4], states[2][4])


def test_masks_made_of_the_other_views_do_not_tell_of_the_held_out_one(fold):
    def with_gap(scene):
        blank = [m if i != 3 else torch.ones_like(m) for i, m in enumerate(scene.train.masks)]
        origins = ("given", "given", "given", "missing")
        return replace(scene, train=replace(scene.train, masks=blank, mask_origins=origins))

    scene, moved = with_gap(fake.tiny_scene()), with_gap(_poisoned(fake.tiny_scene(), 1))
    masks = [fill_masks(hold_out(s, 1), "hull").train.masks[-1] for s in (scene, moved)]
    assert torch.equal(*masks) and 0 < int(masks[0].sum()) < masks[0].numel()
    assert not torch.equal(masks[0], fill_masks(moved, "hull").train.masks[-1])
    summary = fold(scene, "gap", missing_masks="hull")
    assert summary["views"] == list(scene.train.names[:3]), (
        "a view without a mask has nothing to be measured by"
    )


def test_held_out_views_are_the_tests_and_nothing_else_is():
    scene = fake.tiny_scene()
    for i, name in enumerate(scene.train.names):
        part = hold_out(scene, i)
        assert list(part.test.names) == [name] and torch.equal(part.test.images[0], scene.train.images[i])
        rest = [n for n in scene.train.names if n != name]
        assert list(part.train.names) == rest == part.source["train"] and part.source["held_out"] == name
        assert torch.equal(part.test.cameras.centres[0], scene.train.cameras.centres[i])
        assert len(part.train.cameras) == 3 and torch.equal(
            part.train.masks[-1], scene.train.masks[-1 - (i == 3)]
        )


def test_the_command_ends_with_mean_and_worst_pictures_and_resumes(fakes, capsys):
    assert evaluate.main(WORDS) == 0
    out, err = capsys.readouterr()
    assert "each view held out in turn" in out and "mean" in out and "worst" in out
    assert "4 of 4: without train_3.png" in err and "loo/leave_one_out.png" in out
    summary = json.loads(Path("loo/leave_one_out.json").read_text())
    assert list(summary["per_view"]) == [f"train_{i}.png" for i in range(4)] and not summary["failed"]
    for name, run in summary["runs"].items():
        record = json.loads((Path("loo") / run / "run.json").read_text())
        assert record["data"]["test"] == [name] and name not in record["data"]["train"]
        assert record["metrics"]["per_view"][name]["psnr"] == summary["per_view"][name]["psnr"]
    assert "test_" not in json.dumps(summary["per_view"])
    sheet = cv2.imread("loo/leave_one_out.png")
    assert sheet.shape[1] > 4 * 250 and sheet.shape[0] > 3 * 200
    before = {p: p.stat().st_mtime_ns for p in Path("loo").glob("*/run.json")}
    assert evaluate.main([*WORDS, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert before == {p: p.stat().st_mtime_ns for p in before}
    assert json.loads(Path("loo/leave_one_out.json").read_text()) == summary


def test_a_run_without_a_view_can_be_measured_again(fakes, capsys):
    assert evaluate.main([*WORDS, "--quiet"]) == 0
    before = json.loads(Path("loo/train_2/run.json").read_text())
    assert evaluate.main(["loo/train_2", "--quiet"]) == 0
    assert json.loads(Path("loo/train_2/run.json").read_text())["metrics"] == before["metrics"]


def test_without_a_method_the_default_one_is_taken(fakes, monkeypatch, capsys):
    from visdom_plugin.cli.evaluation import leave_one_out

    monkeypatch.setattr(leave_one_out, "DEFAULT_METHOD", "fake")
    assert evaluate.main(["--leave-one-out", "--method.steps", "3", "--seed", "2"]) == 0
    assert Path("runs/ball/4/fake/2-leave-one-out/leave_one_out.json").exists()
    assert "chooses another method" in capsys.readouterr().err
    assert evaluate.main(["--leave-one-out", "--show-config"]) == 0
    assert "method: fake" in capsys.readouterr().out


def _fail_without(view, error, monkeypatch):
    from visdom_plugin.training import run

    train = run.train

    def fail(name, config, scene, **keywords):
        if scene.source["held_out"] == view:
            raise error("it went wrong")
        return train(name, config, scene, **keywords)

    monkeypatch.setattr(run, "train", fail)


@pytest.mark.parametrize("error", [EmptyHullError, SceneError, TrainingError])
def test_a_view_without_which_nothing_can_be_made_fails_alone(fold, monkeypatch, error):
    _fail_without("train_2.png", error, monkeypatch)
    summary = fold(fake.tiny_scene(), "some", config=fake.FakeConfig(steps=3))
    assert summary["failed"] == {"train_2.png": "it went wrong"}
    assert list(summary["per_view"]) == ["train_0.png", "train_1.png", "train_3.png"]
    values = [row["psnr"] for row in summary["per_view"].values()]
    assert summary["mean"]["psnr"] == pytest.approx(sum(values) / 3)
    assert json.loads(Path("some/leave_one_out.json").read_text()) == summary


@pytest.mark.parametrize("error", [CheckpointError, ConfigError, PluginError])
def test_what_is_wrong_with_every_view_stops_at_once(fold, monkeypatch, error):
    _fail_without("train_0.png", error, monkeypatch)
    with pytest.raises(error):
        fold(fake.tiny_scene(), "some", config=fake.FakeConfig(steps=3))
    assert not list(Path("some").glob("*"))


def test_missing_masks_stop_at_once(fold):
    scene = fake.tiny_scene()
    gap = replace(scene.train, mask_origins=("given", "given", "given", "missing"))
    with pytest.raises(SceneError, match=r"train_3\.png"):
        fold(replace(scene, train=gap), "some")
    assert not Path("some").exists()


def test_training_that_diverges_is_told_of_every_view(fakes, capsys):
    assert evaluate.main([*WORDS, "--method.nan-at", "3"]) == 1
    summary = json.loads(Path("loo/leave_one_out.json").read_text())
    assert list(summary["failed"]) == summary["views"] == [f"train_{i}.png" for i in range(4)]
    assert all("no longer a finite number at step" in said for said in summary["failed"].values())
    out, err = capsys.readouterr()
    assert "4 of 4: without train_3.png" in err and out.count(" failed ") == 4


def test_too_few_views_and_too_large_a_k_are_said_before_anything_runs(caplog):
    scene = fake.tiny_scene()
    config = fake.FakeConfig(hull=VisibleDomain(k=3))
    few = replace(scene, train=scene.train.take([0, 1]))
    with pytest.raises(SceneError, match="at least 3 training views"):
        check_views(few, config)
    three = replace(scene, train=scene.train.take([0, 1, 3]))
    with pytest.raises(ConfigError, match="K = 3, but 2 views are left") as caught:
        check_views(three, config)
    assert "--k 2" in caught.value.todo
    check_views(three, fake.FakeConfig(hull=VisibleDomain(k="n-1")))
    check_views(three, fake.FakeConfig(hull=VisibleDomain(kind="traditional")))
    check_views(three, fake.FakeConfig())
    caplog.set_level("INFO")
    check_views(scene, config)
    assert "every one of them" in caplog.text


def test_mean_and_worst():
    rows = {
        "a": {"psnr": 10.0, "outside_hull_mass": 0.1, "lpips": None},
        "b": {"psnr": 30.0, "outside_hull_mass": 0.5, "lpips": None},
        "c": {"psnr": 20.0, "outside_hull_mass": 0.3, "lpips": None},
    }
    found = summarise(rows)
    assert (found["mean"]["psnr"], found["mean"]["lpips"], found["worst"]["lpips"]) == (20.0, None, None)
    assert found["worst"]["psnr"] == {"view": "a", "value": 10.0}
    assert found["worst"]["outside_hull_mass"] == {"view": "b", "value": 0.5}


@pytest.mark.parametrize("count", [3, 4, 9])
def test_all_photographs_can_train_where_nothing_but_the_layout_sets_some_aside(tmp_path, count):
    names = [f"{i}.jpg" for i in range(count)]
    found = choose(tmp_path, names, Request(views=count, hold_out=False), every_eighth(range(count)))
    assert found.train == list(range(count)) and found.test == []
    # Where no more views are there than are wanted, they do so without being asked.
    assert choose(tmp_path, names, Request(views=count), every_eighth(range(count))) == found
    assert 0 in choose(tmp_path, names, Request(views=1), every_eighth(range(count))).test
    # What an index file sets aside stays there.
    (tmp_path / "sparse_test.txt").write_text("1\n")
    found = choose(tmp_path, names, Request(views=2, hold_out=False), every_eighth(range(count)))
    assert found.test == [1] and 1 not in found.train and 0 in found.train
