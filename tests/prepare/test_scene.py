"""What is made of photographs: masks of every source, orientation, runs again, a check and a training."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from datamodules import load
from datamodules.files.images import turn, undo_turn
from tests.prepare.poses import exports
from visdom_plugin.atomic_files import MARK
from visdom_plugin.cli.commands import check as check_command
from visdom_plugin.cli.commands.prepare import main
from visdom_plugin.cli.commands.train import main as train
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.hull.checks.mask_checks import border_contact, object_length
from visdom_plugin.prepare import demo, write
from visdom_plugin.prepare.demo import true_mask
from visdom_plugin.prepare.placed import turn_upright


def views_of(scene):
    return load(scene, views=99, train_list="all", test=False, allow_missing_masks=True).train


@pytest.fixture(scope="module")
def with_masks(photographs, tmp_path_factory):
    """The photographs with true masks, some in files beside them, turned as the pictures are stored."""
    folder = tmp_path_factory.mktemp("masked") / "photographs"
    shutil.copytree(photographs.folder, folder)
    (folder / "mattes").mkdir()
    for truth in photographs.truths:
        mask = true_mask(truth, truth.size, photographs.config.radial)
        tag = 6 if truth.size[1] > truth.size[0] else 1
        stored = turn(mask, undo_turn(tag))
        Image.fromarray(stored.astype(np.uint8) * 255).save(
            folder / "mattes" / truth.name.replace("jpg", "png")
        )
    return folder


def test_the_check_finds_nothing_and_a_training_learns(with_masks, tmp_path, capsys):
    scene = tmp_path / "scene"
    assert main([str(with_masks), "--out", str(scene), "--quiet"]) == 0
    assert check_command.main([str(scene), "--views", "6"]) == 0, capsys.readouterr().out
    out = tmp_path / "run"
    words = [
        "method:ingp+vd",
        str(scene),
        "--views",
        "6",
        "--downscale",
        "8",
        "--out",
        str(out),
        "--quiet",
    ]
    assert train([*words, "--method.steps", "60", "--no-report"]) == 0
    losses = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    psnr = [entry["psnr"] for entry in losses if "psnr" in entry]
    assert len(psnr) > 1 and psnr[-1] > psnr[0]


def test_masks_that_are_there_are_taken_and_undistorted(photographs, with_masks, tmp_path):
    assert main([str(with_masks), "--out", str(tmp_path / "scene"), "--quiet"]) == 0
    record = json.loads((tmp_path / "scene" / "prepare.json").read_text())
    assert {v["mask"] for v in record["views"].values()} == {"given"}
    views = views_of(tmp_path / "scene")
    for i, truth in enumerate(photographs.truths):
        mask = views.masks[i].numpy()
        assert mask.shape == truth.size[::-1]
        true = true_mask(truth, truth.size)
        assert (mask & true).sum() / (mask | true).sum() > 0.98


def test_masks_of_some_views_are_kept_and_the_others_made(with_masks, tmp_path, photographs):
    folder = tmp_path / "photographs"
    shutil.copytree(with_masks, folder)
    (folder / "mattes").rename(folder / "masks")
    for i in (2, 3):
        (folder / "masks" / f"IMG_000{i}.png").unlink()
    assert main([str(folder), "--out", str(tmp_path / "scene"), "--quiet"]) == 0
    record = json.loads((tmp_path / "scene" / "prepare.json").read_text())
    assert [v["mask"] for v in record["views"].values()] == ["given", "grabcut", "grabcut", *["given"] * 3]


def test_poses_from_elsewhere_are_tried_on_the_silhouettes(photographs, with_masks, tmp_path, capsys):
    folder = tmp_path / "photographs"
    shutil.copytree(with_masks, folder)
    cameras = []
    for truth in photographs.truths:
        tag = 6 if truth.size[1] > truth.size[0] else 1
        K = torch.tensor(
            [[truth.focal_px, 0, truth.size[0] / 2], [0, truth.focal_px, truth.size[1] / 2], [0, 0, 1]]
        )
        w, h = (torch.tensor(s) for s in truth.size)
        one = Cameras(K.double(), torch.from_numpy(truth.world_from_camera), w, h)
        stored = turn_upright(Cameras.stack([one]), [undo_turn(tag)])
        size = truth.size[::-1] if tag == 6 else truth.size
        cameras.append(exports.True_(truth.name, stored.world_from_camera[0].numpy(), truth.focal_px, size))
    exports.transforms(tmp_path / "right.json", cameras)
    assert main([str(folder), "--poses", str(tmp_path / "right.json"), "--out", str(tmp_path / "right")]) == 0
    assert "the silhouettes fit the poses" in capsys.readouterr().out
    found = views_of(tmp_path / "right").cameras.world_from_camera.numpy()
    np.testing.assert_allclose(found, np.stack([t.world_from_camera for t in photographs.truths]), atol=1e-6)
    wrong = [c._replace(pose=np.linalg.inv(c.pose)) for c in cameras]
    exports.transforms(tmp_path / "wrong.json", wrong)
    assert main([str(folder), "--poses", str(tmp_path / "wrong.json"), "--out", str(tmp_path / "wrong")]) == 0
    assert "the silhouettes doubt the poses" in capsys.readouterr().out


def test_without_masks_and_board_nothing_is_guessed(photographs, prepared, tmp_path, capsys):
    folder = tmp_path / "photographs"
    shutil.copytree(prepared / "images", folder / "images")
    words = [str(folder), "--poses", str(prepared / "transforms.json"), "--out", str(tmp_path / "scene")]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "nothing says where the object is" in said and "--mask-source none" in said
    assert not (tmp_path / "scene").exists()
    assert main([*words, "--mask-source", "none", "--quiet"]) == 0
    np.testing.assert_allclose(
        views_of(tmp_path / "scene").cameras.world_from_camera, views_of(prepared).cameras.world_from_camera
    )


@pytest.mark.parametrize("tag", [1, 3, 6, 8])
def test_cameras_turn_with_their_pictures(tag):
    K = torch.tensor([[300.0, 0, 110], [0, 310, 70], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    camera = Cameras.from_matrices(K[None], pose[None], width=200, height=150)
    turned = turn_upright(camera, [tag])
    picture = np.zeros((150, 200))
    point = torch.tensor([[0.0217, -0.0512, 1.0]], dtype=torch.float64)
    u, v = project(camera[0], point)[0][0].tolist()
    picture[int(v), int(u)] = 1
    shown = turn(picture, tag)
    x, y = project(turned[0], point)[0][0].tolist()
    assert shown[int(y), int(x)] == 1 and shown.shape == (int(turned.height[0]), int(turned.width[0]))
    assert turned.intrinsics[0, 0, 1].abs() < 1e-12 and turned.intrinsics[0, 0, 0] > 0


def test_changed_masks_are_kept(photographs, prepared, tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(prepared, scene)
    mask = scene / "masks" / "IMG_0001.png"
    Image.open(mask).transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(mask)
    own = mask.read_bytes()
    assert main([str(photographs.folder), "--out", str(scene)]) == 0
    assert "changed since they were written: masks/IMG_0001.png" in capsys.readouterr().out
    assert mask.read_bytes() == own


def test_a_run_that_fails_leaves_the_scene_as_it_was(photographs, prepared, tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    shutil.copytree(prepared, scene)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(write, "finish", full)
    words = [
        str(photographs.folder),
        "--out",
        str(scene),
        "--overwrite",
        "--mask-source",
        "none",
        "--size",
        "200",
    ]
    assert main(words) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["scene"] and not list(tmp_path.glob(f"{MARK}*"))
    assert (scene / "prepare.json").read_bytes() == (prepared / "prepare.json").read_bytes()
    monkeypatch.undo()
    assert main([*words, "--quiet"]) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    assert max(Image.open(scene / "images" / "IMG_0001.png").size) == 200


def test_colmap_that_is_not_there_is_said(photographs, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    assert main([str(photographs.folder), "--colmap", "--out", str(tmp_path / "scene")]) == 2
    assert "pycolmap is not installed" in capsys.readouterr().err


@pytest.mark.slow
def test_colmap_places_a_dozen(tmp_path):
    pytest.importorskip("pycolmap", reason="the extra colmap is not installed")
    from visdom_plugin.prepare.demo import DemoConfig, write_demo

    truths = write_demo(tmp_path / "photographs", DemoConfig(views=12, size=(960, 720), portrait=False))
    words = ["--colmap", "--mask-source", "none", "--quiet"]
    assert main([str(tmp_path / "photographs"), *words, "--out", str(tmp_path / "scene")]) == 0
    centres = views_of(tmp_path / "scene").cameras.centres.numpy()
    true = np.stack([t.world_from_camera[:3, 3] for t in truths])
    assert len(centres) == 12
    # Distances between cameras are those of the truth up to one scale.
    apart, real = (
        np.linalg.norm(c[:, None] - c[None], axis=-1)[np.triu_indices(12, 1)] for c in (centres, true)
    )
    ratio = apart / real
    assert ratio.std() / ratio.mean() < 0.03


def test_the_object_fills_the_frames_of_the_demo_and_is_whole(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(demo, "write_demo", lambda folder, config, board: asked.append(config) or [])
    assert main(["--demo", str(tmp_path / "photographs"), "--quiet"]) == 0
    monkeypatch.undo()
    (config,) = asked
    config = replace(config, size=(160, 120), samples=1)
    lengths = []
    for truth in demo.write_demo(tmp_path / "small", config):
        mask = true_mask(truth, truth.size, config.radial)
        assert not border_contact(mask)
        lengths.append(object_length(mask) / min(truth.size))
    assert len(lengths) == 12 and min(lengths) > 0.35 and np.mean(lengths) > 0.5
