"""Cameras go from COLMAP's models to ActorsHQ's table and back without loss."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.files.colmap_model import cameras_of as cameras_of_model
from datamodules.files.colmap_model import read_model
from datamodules.layouts.actorshq import cameras_of, parse_calibration
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.cli import convert
from visdom_plugin.export.calibration_csv import write_calibration
from visdom_plugin.export.dataset import write_colmap
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion


@pytest.fixture(scope="module")
def tiny():
    return make_scene(SyntheticConfig(size=(32, 24), train_views=5, test_views=0))


def random_cameras(count=40):
    random = np.random.default_rng(3)
    quaternion = torch.from_numpy(random.normal(size=(count, 4)))
    quaternion[0] = torch.tensor([1.0, 0, 0, 0])
    quaternion[1] = torch.tensor([0.0, 0, 1, 0])  # half a turn
    quaternion[2] = torch.tensor([1.0, 1e-9, 0, 0])
    motion = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    motion[:, :3, :3] = matrix_from_quaternion(quaternion)
    reach = 10.0 ** random.integers(-3, 4, (count, 1))
    motion[:, :3, 3] = torch.from_numpy(random.normal(size=(count, 3)) * reach)
    size = torch.from_numpy(random.integers(100, 5000, (2, count)))
    K = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = torch.from_numpy(random.uniform(90, 4000, (4, count)))
    return Cameras(K, motion, *size)


def same(one: Cameras, other: Cameras) -> bool:
    spread = one.centres.abs().amax(-1).clamp_min(1)
    return bool(
        torch.equal(one.width, other.width)
        and torch.equal(one.height, other.height)
        and (one.intrinsics - other.intrinsics).abs().max() < 1e-6
        and (one.world_from_camera[:, :3, :3] - other.world_from_camera[:, :3, :3]).abs().max() < 1e-9
        and ((one.centres - other.centres).abs().amax(-1) / spread).max() < 1e-9
    )


def read_table(path):
    rows = parse_calibration(path.read_bytes(), path)
    return [row["name"] for row in rows], cameras_of(rows, path)


def read_colmap(folder):
    images = sorted(read_model(folder, "").images, key=lambda image: image.name)
    return [image.name for image in images], cameras_of_model(read_model(folder, ""), images)[0]


def test_random_cameras_go_round_both_ways(tmp_path):
    cameras = random_cameras()
    names = [f"Cam{i + 1:03d}" for i in range(len(cameras))]
    write_calibration(tmp_path / "calibration.csv", cameras, names)
    assert read_table(tmp_path / "calibration.csv")[0] == names
    assert same(read_table(tmp_path / "calibration.csv")[1], cameras)
    assert convert.main([str(tmp_path), "--out", str(tmp_path / "model")]) == 0
    found, there = read_colmap(tmp_path / "model")
    assert found == [f"{name}.jpg" for name in names] and same(there, cameras)
    assert convert.main([str(tmp_path / "model"), "-o", str(tmp_path / "again.csv")]) == 0
    again, back = read_table(tmp_path / "again.csv")
    assert again == names and same(back, cameras)
    write_colmap(tmp_path / "second", [back[i] for i in range(len(back))], found)
    assert same(read_colmap(tmp_path / "second")[1], cameras)


def test_a_sequence_becomes_a_scene_of_colmaps_layout(tiny, tmp_path, capsys):
    folder = w.write_actorshq(tiny.train, tmp_path / "s", frame=12)
    expected = load(folder, train_list="all").train
    scene = tmp_path / "scene"
    words = ["--image-names", "{name}/{name}_rgb000012.jpg", "--out", str(scene / "sparse/0")]
    assert convert.main([str(folder), *words]) == 0 and "cameras: " in capsys.readouterr().out
    (folder / "1x/rgbs").rename(scene / "images")
    for path in (folder / "1x/masks").rglob("*.png"):
        (scene / "masks").mkdir(exist_ok=True)
        path.rename(scene / "masks" / path.name.replace("_mask", "_rgb"))
    found = load(scene, train_list="all").train
    assert same(found.cameras, expected.cameras)
    assert all(map(torch.equal, found.images, expected.images))
    assert all(map(torch.equal, found.masks, expected.masks))
    assert convert.main([str(scene), "--out", str(tmp_path / "back.csv")]) == 0
    assert same(read_table(tmp_path / "back.csv")[1], expected.cameras)
    assert read_table(tmp_path / "back.csv")[0] == list(expected.names)


def test_wrong_places_and_models_are_refused(tiny, tmp_path, capsys):
    def said(*words):
        assert convert.main([str(word) for word in words]) == 2
        return capsys.readouterr().err

    folder = w.write_actorshq(tiny.train, tmp_path / "s", scales=(1, 2))
    table, model = folder / "1x/calibration.csv", tmp_path / "model"
    assert "there are 2 tables" in said(folder, "--out", model)
    assert "a table is converted to a model" in said(table, "--out", "x.csv")
    assert "would have one name" in said(table, "--out", model, "--image-names", "a.jpg")
    assert "no name can be made" in said(table, "--out", model, "--image-names", "{frame}.jpg")
    assert "outside its folder" in said(table, "--out", model, "--image-names", "../{name}.jpg")
    assert "no such file" in said(tmp_path / "none", "--out", model) and not model.exists()
    assert convert.main([str(table), "--out", str(model)]) == 0
    assert "already" in said(table, "--out", model)
    assert convert.main([str(table), "--out", str(model), "--overwrite"]) == 0
    out = tmp_path / "t.csv"
    assert "a .csv file" in said(model, "--out", tmp_path / "t")
    assert "neither a COLMAP model nor" in said(tmp_path, "--out", out)
    bent = tmp_path / "bent"
    bent.mkdir()
    (bent / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a/1.jpg\n\n2 1 0 0 0 0 0 0 1 b/1.jpg\n\n")
    (bent / "cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 60 32 24 0.1\n")
    assert "lens distortion" in said(bent, "--out", out) and not out.exists()
    (bent / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    assert "two photographs would be of camera 1" in said(bent, "--out", out) and not out.exists()


def test_help_loads_nothing_heavy():
    code = "import sys; from visdom_plugin.cli import convert\n"
    code += (
        "try: convert.main(['--help'])\nexcept SystemExit: pass\nprint({'torch', 'numpy'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "calibration.csv" in done.stdout and done.stdout.endswith("set()\n")
