"""From photographs with a board to a scene: poses, masks, files, and running it again."""

from __future__ import annotations

import hashlib
import json

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from visdom_plugin.cli.commands.prepare import main
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import project
from visdom_plugin.prepare.board import corner_points, find_corners
from visdom_plugin.prepare.demo import true_mask
from visdom_plugin.prepare.settings import BoardSettings
from visdom_plugin.prepare.write import find_earlier, read_record


def hashes(folder) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def views_of(scene):
    return load(scene, views=99, train_list="all", test=False).train


def test_poses_are_the_true_ones_in_metres(photographs, prepared):
    views = views_of(prepared)
    assert [n.partition("/")[2] for n in views.names] == [
        t.name.replace("jpg", "png") for t in photographs.truths
    ]
    for i, truth in enumerate(photographs.truths):
        found = views.cameras.world_from_camera[i].numpy()
        turn = found[:3, :3].T @ truth.world_from_camera[:3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        away = np.linalg.norm(found[:3, 3] - truth.world_from_camera[:3, 3])
        assert angle < 1.0 and away < 0.02 * np.linalg.norm(truth.world_from_camera[:3, 3]), truth.name
        assert views.cameras.intrinsics[i, 0, 0] == pytest.approx(truth.focal_px, rel=0.01)
        assert (views.images[i].shape[1], views.images[i].shape[0]) == truth.size


def test_the_board_lies_where_the_cameras_of_the_scene_see_it(photographs, prepared):
    """Pictures, distortion, orientation and cameras fit: corners found again in the written pictures."""
    views = views_of(prepared)
    points, total = torch.from_numpy(corner_points(BoardSettings())), 0
    for i, image in enumerate(views.images):
        found = find_corners(cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY), BoardSettings())
        away = project(views.cameras[i], points[found.ids])[0].numpy() - found.uv
        total += len(found.ids)
        assert np.median(np.linalg.norm(away, axis=-1)) < 1.0
    assert total > 60
    # Half way to the pictures' corners the lens bends by far more than that.
    k1, k2 = photographs.config.radial
    assert abs(k1 * 0.4**3 + k2 * 0.4**5) * photographs.truths[0].focal_px > 5


def test_masks_are_near_the_true_ones(photographs, prepared):
    views = views_of(prepared)
    ious = []
    for i, truth in enumerate(photographs.truths):
        mask = views.masks[i].numpy()
        true = true_mask(truth, (mask.shape[1], mask.shape[0]))
        ious.append((mask & true).sum() / (mask | true).sum())
    assert min(ious) > 0.75 and np.mean(ious) > 0.85, ious


def test_the_record_says_what_was_done(photographs, prepared):
    record = json.loads((prepared / "prepare.json").read_text())
    assert record["poses"]["units"] == "metres" and record["left_out"] == {}
    taken = hashes(photographs.folder)
    assert record["asked"]["photographs"] == taken
    assert {v["orientation"] for v in record["views"].values()} == {1, 6}
    assert all(v["reprojection_px"] < 1 for v in record["views"].values())
    written = hashes(prepared)
    del written["prepare.json"]
    assert record["written"] == written and "prepare.png" in written


def test_again_changes_nothing(photographs, prepared, capsys):
    before, taken = hashes(prepared), hashes(photographs.folder)
    times = {p: p.stat().st_mtime_ns for p in prepared.rglob("*")}
    assert main([str(photographs.folder), "--out", str(prepared)]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert hashes(prepared) == before and times == {p: p.stat().st_mtime_ns for p in prepared.rglob("*")}
    assert hashes(photographs.folder) == taken and not list(prepared.parent.glob(".part-*"))


def test_other_settings_are_refused_and_nothing_is_lost(photographs, prepared, capsys):
    before, size = hashes(prepared), read_record(prepared)["asked"]["settings"]["size"]
    words = [str(photographs.folder), "--out", str(prepared), "--size", "400", "--mask-rounds", "1"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--overwrite" in said and hashes(prepared) == before
    assert f"settings: size was {size}, now 400, rounds was " in said and "now 1" in said


def test_other_photographs_are_named(photographs, prepared):
    asked = read_record(prepared)["asked"]
    one, two, *_ = asked["photographs"]
    now = dict(asked["photographs"]) | {one: "0" * 64, "new.jpg": "1" * 64}
    del now[two]
    with pytest.raises(ConfigError, match=rf"photographs or settings: {one}, new\.jpg, {two}\n") as caught:
        find_earlier(prepared, asked | {"photographs": now}, overwrite=False)
    assert caught.value.topic == "other-run"
