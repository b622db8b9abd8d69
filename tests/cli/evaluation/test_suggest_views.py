"""The check says how good the default choice of views is, and names a better one."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.layout_writers import write_colmap
from visdom_plugin.cli.commands.check import main
from visdom_plugin.cli.evaluation.suggest_views import pick_apart


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(48, 36), train_views=12, test_views=0)).train


def _choice(folder, capsys, *words):
    assert main([str(folder), "--json", *words]) in (0, 1)
    return json.loads(capsys.readouterr().out).get("choice")


def test_directions_far_apart_are_picked():
    angles = np.radians([0, 5, 10, 90, 95, 180, 184, 270, 275])
    directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    best = np.degrees(angles[sorted(pick_apart(directions, 4))])
    assert np.diff(np.append(best, best[0] + 360)).min() >= 85


def test_a_better_choice_is_named_and_can_be_trained_on(views, tmp_path, capsys):
    folder = write_colmap(views, tmp_path / "scene")
    choice = _choice(folder, capsys)
    assert choice["best_degrees"] > choice["degrees"] + 5 and len(choice["best"]) == 4
    listed = ",".join(Path(name).stem for name in choice["best"])
    assert choice["said"].splitlines()[-1] == f"--train-list {listed}"
    assert set(load(folder, train_list=listed, test=False).train.names) == set(choice["best"])
    # On a terminal, too, the option is one line, which can be copied.
    assert main([str(folder)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert f"--train-list {listed}" in shown and shown[0].startswith(f"scene: 4 of {choice['free']} views")
    # Who names views is not told of others, and the best of them is not bettered.
    assert _choice(folder, capsys, "--train-list", listed) is None


def test_views_that_are_cut_off_are_passed_over(views, tmp_path, capsys):
    folder = write_colmap(views, tmp_path / "scene")
    first = _choice(folder, capsys)["best"]
    cut = first[0]
    path = next((folder / "masks").glob(f"{cut.split('.')[0]}.*"))
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    mask[20:, :] = 255
    cv2.imwrite(str(path), mask)
    choice = _choice(folder, capsys)
    assert choice["best"] and cut not in choice["best"]


def test_nothing_is_suggested_where_all_views_train(views, tmp_path, capsys):
    folder = write_colmap(views, tmp_path / "scene")
    assert _choice(folder, capsys, "--views", "12") is None
