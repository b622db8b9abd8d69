"""Runs that carve and measure a hull alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from datamodules.files.target_mesh import find_mesh, load_mesh
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin.cli.hulls import measure_hull as command
from visdom_plugin.errors import CheckpointError, EmptyHullError, SceneError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.grid.mesh import is_closed
from visdom_plugin.training.hull_run.config import HullRunConfig
from visdom_plugin.training.hull_run.run import DISTANCES, VOLUMES, carve_run, measure_hull

DOMAIN = VisibleDomain(resolution=48)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=64, test_views=2))


def test_kinds_nest_and_the_looser_hull_is_farther_from_the_object(scene):
    config = HullRunConfig(replace(DOMAIN, kind="traditional"), samples=4000)
    box = measure_hull(scene, config)["hull"].bounds
    whole = measure_hull(scene, replace(config, hull=DOMAIN))["hull"].extent
    centre, radius = whole.mean(0), float(np.linalg.norm(whole[1] - whole[0]) / 2)
    shared = {"bounds": tuple(map(tuple, box.tolist())), "sphere_centre": tuple(centre.tolist())}
    shared["sphere_radius"] = 1.05 * radius
    grids, tests = [], []
    for kind, pieces in (("visdom", "explain"), ("unit-sphere", "all"), ("traditional", "all")):
        domain = replace(DOMAIN, kind=kind, components=pieces, **shared)
        found = measure_hull(scene, replace(config, hull=domain))
        grids.append(found["hull"].occupancy)
        tests.append(found["metrics"]["test"])
    assert grids[0].any() and not (grids[0] & ~grids[1]).any() and not (grids[1] & ~grids[2]).any()
    assert tests[2]["volume"] > tests[1]["volume"] >= tests[0]["volume"]
    assert tests[2]["chamfer_hull_to_target"] > 2 * tests[1]["chamfer_hull_to_target"]
    assert tests[2]["iou"] < tests[1]["iou"]


def test_numbers_agree_with_each_other_and_grow_with_the_square_of_the_unit(scene):
    config = HullRunConfig(DOMAIN, samples=3000)
    test = measure_hull(scene, config, seed=4)["metrics"]["test"]
    assert test["chamfer_sym"] == test["chamfer_target_to_hull"] + test["chamfer_hull_to_target"]
    assert 0 < test["chamfer_floor"] < 0.3 * test["chamfer_sym"]
    assert 0 < test["iou"] < test["covered"] <= 1
    shared = test["covered"] * test["target_volume"]
    assert test["iou"] == pytest.approx(shared / (test["volume"] + test["target_volume"] - shared))
    assert measure_hull(scene, config, seed=4)["metrics"]["test"] == test
    cameras = scene.train.cameras
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] *= 4
    grown = replace(scene.train, cameras=replace(cameras, world_from_camera=motion))
    larger = replace(scene, train=grown, mesh=(4 * scene.mesh[0], scene.mesh[1]))
    other = measure_hull(larger, config, seed=4)["metrics"]["test"]
    for name in DISTANCES:
        assert other[name] == pytest.approx(16 * test[name], rel=1e-6), name
    assert other["iou"] == pytest.approx(test["iou"], rel=1e-6)


def test_a_run_leaves_a_directory_that_is_done_once(scene, tmp_path, monkeypatch):
    config, run = HullRunConfig(DOMAIN, samples=500), tmp_path / "run"
    record = carve_run(config, scene, run_dir=run, request={"views": 4})
    assert json.loads((run / "run.json").read_text()) == {
        k: v for k, v in record.items() if k != "already_finished"
    }
    assert (record["status"], record["method"], record["metrics"]["per_view"]) == ("finished", "hull", {})
    assert record["config"]["hull"]["kind"] == "visdom" and record["metrics"]["target"]["samples"] == 500
    assert set(record["timing"]) == {"hull_s", "eval_s"} and (run / "hull" / "hull.ply").exists()
    monkeypatch.setattr(VisibleDomain, "carve", None)
    assert carve_run(config, scene, run_dir=run, request={"views": 4})["already_finished"]
    with pytest.raises(CheckpointError, match=r"config\.hull\.k: 3 -> 2"):
        carve_run(replace(config, hull=replace(DOMAIN, k=2)), scene, run_dir=run, request={"views": 4})


def test_without_a_target_there_are_no_distances(scene, tmp_path, caplog):
    bare = replace(scene, mesh=None)
    record = carve_run(HullRunConfig(DOMAIN, samples=500), bare, run_dir=tmp_path / "run")
    test = record["metrics"]["test"]
    assert all(test[name] is None for name in (*DISTANCES, *VOLUMES)) and test["volume"] > 0
    assert record["status"] == "finished" and record["metrics"]["target"]["missing"]
    assert "no target" in caplog.text and "mesh.ply" in caplog.text


def test_an_empty_hull_leaves_nothing(scene, tmp_path):
    away = VisibleDomain(resolution=16, bounds=((90, 90, 90), (91, 91, 91)))
    with pytest.raises(EmptyHullError):
        carve_run(HullRunConfig(away), scene, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
def test_meshes_beside_the_data_are_found_and_stay_closed(scene, tmp_path, suffix):
    mesh = trimesh.Trimesh(*(x.numpy() for x in scene.mesh), process=False)
    (tmp_path / "meshes").mkdir()
    for name in (f"mesh.{suffix}", f"meshes/actor_000015.{suffix}", f"meshes/actor_000016.{suffix}"):
        mesh.export(tmp_path / name)
    assert find_mesh(tmp_path).name == f"mesh.{suffix}"
    assert find_mesh(tmp_path, 15).name == f"actor_000015.{suffix}"
    assert find_mesh(tmp_path, 3).name == f"mesh.{suffix}"
    assert find_mesh(tmp_path / "meshes") is None
    vertices, faces = load_mesh(find_mesh(tmp_path, 15))
    assert vertices.dtype == torch.float64 and faces.dtype == torch.int64
    assert is_closed(faces.numpy()) and len(faces) == len(mesh.faces)
    low, high = mesh.bounds.tolist()
    load_mesh(tmp_path / f"mesh.{suffix}", [low, high])
    with pytest.raises(SceneError, match="other units"):
        load_mesh(tmp_path / f"mesh.{suffix}", [[100 * x for x in low], [100 * x for x in high]])
    (tmp_path / "meshes" / f"other_15.{suffix}").write_bytes(b"")
    with pytest.raises(SceneError, match="2 meshes"):
        find_mesh(tmp_path, 15)
    with pytest.raises(SceneError, match=r"cannot be read|no triangles"):
        load_mesh(tmp_path / "meshes" / f"other_15.{suffix}")


def test_the_command_writes_what_the_function_measures(tmp_path, capsys):
    argv = ["--downscale", "4", "--method.hull.resolution", "48", "--method.samples", "400"]
    assert command.main([*argv, "--out", str(tmp_path / "a")]) == 0
    assert "chamfer_sym" in capsys.readouterr().out
    assert command.main([*argv, "--show-config"]) == 0
    (tmp_path / "c.yaml").write_text(capsys.readouterr().out)
    assert command.main(["--config", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "b"), "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    a, b = (json.loads((tmp_path / n / "run.json").read_text())["metrics"] for n in "ab")
    assert a == b
    assert command.main(["method:ingp"]) == 2
