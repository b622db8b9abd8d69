"""visdom-export on files of Gaussians: conversions, and what cannot be converted."""

import json
import shlex

import numpy as np
import pytest
import torch

from tests.splat.twin import make_gaussians
from visdom_plugin.cli.commands import export
from visdom_plugin.cli.output.terminal import show_next
from visdom_plugin.export.splat_files import read_near, read_splats
from visdom_plugin.splat.ply import write_gaussians

FAR = torch.tensor([500_000.25, 5_400_000.5, 120.0], dtype=torch.float64)


@pytest.fixture
def gaussians():
    return make_gaussians(n=40, dtype=torch.float32).detach()


@pytest.mark.parametrize("kind", ["spz", "splat"])
def test_a_file_is_converted_beside_itself(tmp_path, gaussians, kind, capsys):
    write_gaussians(tmp_path / "a.ply", gaussians)
    assert export.main([str(tmp_path / "a.ply"), "--format", kind]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / f"a.{kind}")
    back = read_splats(tmp_path / f"a.{kind}").means
    assert np.allclose(np.sort(back.numpy(), 0), np.sort(gaussians.means.numpy(), 0), atol=1e-5)


def test_a_file_in_map_coordinates_is_not_rounded(tmp_path, gaussians, capsys):
    write_gaussians(tmp_path / "a.ply", gaussians, FAR)
    for kind in ("spz", "splat", "sog", "html"):
        assert export.main([str(tmp_path / "a.ply"), "--format", kind]) == 2
        said = capsys.readouterr().err
        assert "map coordinates" in said and "--upright" in said and f".{kind}" in said
        assert not (tmp_path / f"a.{kind}").exists()
    assert export.main([str(tmp_path / "a.ply"), "--out", str(tmp_path / "b.ply"), "--quiet"]) == 0
    near, origin = read_near(tmp_path / "b.ply")
    assert torch.allclose(near.means + origin, gaussians.means + FAR, rtol=0, atol=1e-6)
    assert export.main([str(tmp_path / "b.ply"), "--info"]) == 0
    bounds = np.array(json.loads(capsys.readouterr().out)["bounds"])
    assert np.allclose(bounds[0], (gaussians.means.double() + FAR).amin(0), rtol=0, atol=1e-6)


def test_bad_input_gets_one_clear_line(tmp_path, gaussians, capsys):
    write_gaussians(tmp_path / "a.ply", gaussians)
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat")
    (tmp_path / "empty").mkdir()
    file = str(tmp_path / "a.ply")
    for words, said in (
        ([str(tmp_path / "nothing.ply")], "no such file"),
        ([str(tmp_path / "broken.ply"), "--format", "spz"], "not a PLY point cloud"),
        ([str(tmp_path / "empty")], "not a run directory"),
        ([file], "replace the file itself"),
        ([file, "--format", "glb"], "--data DIR"),
        ([file, "--format", "spz", "--out", "x.ply"], "ends in .spz"),
        ([file, "--format", "spz", "--mesh"], "--mesh is for"),
        ([file, "--format", "spz", "--resolution", "4"], "--resolution is 4"),
    ):
        assert export.main(words) == 2
        assert said in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "broken.ply", "empty"]


@pytest.mark.parametrize("file", ["point_cloud.ply", "mesh.ply"])
def test_the_export_that_training_ends_with_is_one_that_the_run_can_have(file, tmp_path, capsys, monkeypatch):
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / file).touch()
    (tmp_path / "run.json").write_text(json.dumps({"schema": 1, "status": "finished", "method": "m"}))
    show_next(tmp_path)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "visdom-export" in line]
    written = []
    for name in ("_write_splats", "_write_mesh"):
        monkeypatch.setattr(export, name, lambda options, target: written.append(target) or [])
    assert export.main(shlex.split(said, comments=True)[1:]) == 0 and len(written) == 1
