"""Run directories that hold another run, another data set, foreign files or another process."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.training.fake import FakeConfig, FakeInner, tiny_views
from visdom_plugin.errors import CheckpointError

ROOT = Path(__file__).resolve().parents[3]


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
