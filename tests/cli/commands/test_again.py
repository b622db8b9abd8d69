"""Runs looked at again after their data, or what chose their views, has changed."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from datamodules import load
from tests.datamodules.layouts import test_layouts as layouts
from tests.datamodules.layouts.layout_writers import write_colmap
from tests.training import fake
from visdom_plugin import registry
from visdom_plugin.cli import runs
from visdom_plugin.cli.commands import evaluate, render, train
from visdom_plugin.errors import CheckpointError
from visdom_plugin.scene import hold_out
from visdom_plugin.training.run import add_points
from visdom_plugin.training.runs.run_directory import describe_data

free, plain = layouts.free, layouts.plain
TRAIN = ["method:fake", "--method.steps", "6", "--quiet"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Seven views on disk; the fake methods are the only ones."""
    monkeypatch.setattr(registry, "installed", fake.fake_registry)
    monkeypatch.chdir(tmp_path)
    return write(tmp_path / "somewhere")


def write(folder: Path, prefix: str = "v") -> Path:
    """Seven views as a COLMAP model and images v0.png, ..."""
    views = fake.tiny_views(7, 0, prefix)
    return write_colmap(replace(views, names=[Path(name).stem for name in views.names]), folder)


@pytest.fixture
def listed(folder):
    """A run whose views were chosen by files."""
    Path("train.txt").write_text("1 3 5 6")
    Path("test.txt").write_text("0 2")
    lists = ["--train-list", "train.txt", "--test-list", "test.txt"]
    assert train.main([*TRAIN, "--data", str(folder), "--out", "run", *lists]) == 0
    return Path("run")


def frames(path, run):
    words = [str(run), "--path", path, "--frames", "2", "--format", "png", "--out", f"of_{path}", "--quiet"]
    return render.main(words)


def whiten(path: Path) -> None:
    cv2.imwrite(str(path), 0 * cv2.imread(str(path)) + 255)


def read(run: Path) -> dict:
    return json.loads((run / "run.json").read_text())


def test_changed_test_views_are_neither_measured_nor_rendered(folder, listed, capsys):
    before = read(listed)
    whiten(next(folder.glob("images/v2.png")))
    assert evaluate.main([str(listed)]) == 2
    assert "is not the one this run was measured on" in capsys.readouterr().err
    assert frames("test", listed) == 2 and not Path("of_test").exists()
    assert read(listed) == before
    # Other paths do without them.
    for path in ("orbit", "between", "train"):
        assert frames(path, listed) == 0, capsys.readouterr().err
    whiten(next(folder.glob("images/v3.png")))
    assert frames("orbit", listed) == 2
    assert "is not the one this run was trained on" in capsys.readouterr().err


def test_files_of_test_views_are_not_needed_where_nobody_looks_at_them(folder, listed, capsys):
    next(folder.glob("images/v2.png")).unlink()
    assert frames("orbit", listed) == 0, capsys.readouterr().err
    assert evaluate.main([str(listed), "--quiet"]) == 2


@pytest.mark.parametrize("now", ["2 4", "0 2 4", None])
def test_the_views_of_a_run_stay_whatever_its_lists_say_now(listed, capsys, now):
    before = read(listed)
    for name in ("train.txt", "test.txt"):
        Path(name).write_text(now) if now else Path(name).unlink()
    assert evaluate.main([str(listed), "--quiet"]) == 0, capsys.readouterr().err
    assert read(listed)["metrics"] == before["metrics"] and read(listed)["data"] == before["data"]
    assert list(before["metrics"]["per_view"]) == before["data"]["test"] == ["v0.png", "v2.png"]
    assert frames("test", listed) == 0 and len(list(Path("of_test").iterdir())) == 2


def test_an_interrupted_run_goes_on_where_its_scene_was_renamed_and_its_lists_are_gone(
    folder, listed, capsys, monkeypatch
):
    whole = read(listed)
    lists = ["--train-list", "train.txt", "--test-list", "test.txt"]
    step_of = fake.FakeMethod.train_step
    with monkeypatch.context() as patch:
        patch.setattr(
            fake.FakeMethod,
            "train_step",
            lambda self, batch, step: (
                (step == 3 and signal.raise_signal(signal.SIGINT)) or step_of(self, batch, step)
            ),
        )
        assert train.main([*TRAIN, "--data", str(folder), "--out", "cut", *lists]) == 130
    folder.rename("renamed")
    Path("train.txt").unlink()
    lists = ["--train-list", "1,3,5,6", "--test-list", "v0,v2"]
    words = [word for word in TRAIN if word != "--quiet"]
    assert train.main([*words, "--data", "renamed", "--out", "cut", *lists]) == 0
    assert "resumed after step 4" in capsys.readouterr().err
    assert read(Path("cut"))["metrics"] == whole["metrics"] and read(Path("cut"))["scene"] == "renamed"
    assert evaluate.main(["cut", "--quiet"]) == 0
    # The comparison can fail.
    assert train.main([*TRAIN, "--data", "renamed", "--out", "cut", *lists[:3], "v0"]) == 2
    assert "data.test" in capsys.readouterr().err


@pytest.mark.parametrize("name", layouts.LAYOUTS)
@pytest.mark.parametrize("held_out", [False, True])
def test_every_layout_gives_the_noted_views_again(name, held_out, free, plain, tmp_path):
    """Whatever chose the views; `load_again` compares the hashes itself."""
    _, which, writer, below = layouts.LAYOUTS[name]
    path = writer(free if which == "free" else plain, tmp_path / "thing") / below
    asked = {"views": 5, "downscale": 1.5, "seed": 0}
    scene = load(path, **asked, hold_out=not held_out)
    if held_out:
        scene = hold_out(scene, 2)
    noted = describe_data(scene, {"path": str(path), **asked})
    record = {"method": "3dgs-go", "config": {"hull": {}}}
    again = runs.load_again({**record, "data": json.loads(json.dumps(noted))}, tmp_path, None)
    for part in ("train", "test"):
        assert list(getattr(again, part).names) == noted[part] and (noted[part] or part == "test")
    if noted["test"]:
        noted["test"] = noted["test"][1:] or [noted["train"].pop()]
        with pytest.raises(CheckpointError, match="is not the one this run was"):
            runs.load_again({**record, "data": noted}, tmp_path, None)


def test_runs_that_started_from_the_scenes_points_are_opened_again(tmp_path):
    folder = write(tmp_path / "somewhere")
    cloud = folder / "sparse/0/points3D.txt"
    cloud.write_text("1 0 0 0.1 9 9 9 0.5\n2 0 0.1 0 9 9 9 0.5\n")
    record = {"method": "3dgs-go", "config": {"hull": None}}
    scene = add_points(load(folder), registry.find(record["method"]), None)
    record["data"] = describe_data(scene, {"path": str(folder), "views": 4, "downscale": 1, "seed": 0})
    assert len(runs.load_again(record, tmp_path, None).train.points[0]) == 2
    cloud.write_text("1 0 0 0.1 9 9 9 0.5\n")
    with pytest.raises(CheckpointError, match="is not the one this run was trained on"):
        runs.load_again(record, tmp_path, None)


def test_a_single_view_and_names_with_commas(folder, capsys):
    """One test view is no list's name; a name that cannot be listed is found as it was at first."""
    words = ["--data", str(folder), "--views", "3"]
    assert train.main([*TRAIN, *words, "--out", "one"]) == 0
    assert len(read(Path("one"))["data"]["test"]) == 1
    shutil.copy(folder / "images" / "v0.png", ".")
    assert evaluate.main(["one", "--quiet"]) == 0, capsys.readouterr().err
    odd = write(Path("odd"), "a,b")
    assert train.main([*TRAIN, "--data", str(odd), "--views", "3", "--out", "two"]) == 0
    assert evaluate.main(["two", "--quiet"]) == 0, capsys.readouterr().err


def test_a_scene_without_the_runs_views_is_said(folder, listed, capsys):
    other = write(Path("other"), "w")
    assert evaluate.main([str(listed), "--data", str(other)]) == 2
    err = capsys.readouterr().err
    assert "does not have the views of this run" in err and "--data DIR" in err


def test_pictures_of_other_views_are_removed_and_nothing_else(listed):
    pictures = listed / "renders" / "test"
    (pictures / "v9.png").write_bytes(b"of another evaluation")
    (pictures / "notes.txt").write_text("mine")
    assert evaluate.main([str(listed), "--quiet"]) == 0
    assert sorted(p.name for p in pictures.iterdir()) == ["notes.txt", "v0.png", "v2.png"]
