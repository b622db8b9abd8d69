"""visdom-hull, as a user types it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.hull.balls import ball_masks, ring
from visdom_plugin.cli import options
from visdom_plugin.cli.commands.hull import main
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Scene, Views

CAMERAS = ("train", "test", "orbit")


@pytest.fixture
def scene(monkeypatch):
    """A ball and what sees it, in place of any folder."""
    import datamodules

    cameras = ring(4)
    masks = ball_masks(cameras, [((0.1, 0, 0), 0.5)])
    # Of another grey in each view, so that no two photographs agree.
    images = [(m[..., None].expand(96, 96, 3) * (60 * i)).byte() for i, m in enumerate(masks)]
    views = Views(cameras, images, masks, [f"v{i}.png" for i in range(4)])
    asked = []

    def load(path, **keywords):
        asked.append((path, keywords))
        return Scene("ball", views, views)

    monkeypatch.setattr(datamodules, "load", load, raising=False)
    monkeypatch.setattr(options, "find_folder", Path)
    return asked


def test_json_is_one_object_with_what_is_promised(scene, capsys):
    assert (
        main(["somewhere", "--views", "4", "-k", "2", "--resolution", "48", "--downscale", "2", "--json"])
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert str(scene[0][0]) == "somewhere" and scene[0][1]["views"] == 4 and scene[0][1]["downscale"] == 2
    assert report["resolution"] == 48 and report["shape"] == [48, 48, 48] and report["watertight"] is True
    (x0, _, _), (x1, _, _) = report["bounds"]
    assert report["volume"] == pytest.approx(report["voxels"] * ((x1 - x0) / 48) ** 3)
    assert list(report["coverage"]) == ["v0.png", "v1.png", "v2.png", "v3.png"]
    assert all(0.95 < c <= 1 for c in report["coverage"].values())
    assert (
        report["components"] == 1
        and report["seconds"] >= 0
        and "masks of all of the views" in report["agreement_means"]
    )


def test_the_shape_inside_is_reported_and_written_like_a_hull(scene, capsys, tmp_path):
    words = ["somewhere", "--resolution", "48", "-k", "2"]
    assert main([*words, "--json"]) == 0
    hull = json.loads(capsys.readouterr().out)
    assert main([*words, "--inside", "--json", "--out", str(tmp_path / "inner.ply")]) == 0
    inner = json.loads(capsys.readouterr().out)
    assert (hull["kind"], inner["kind"]) == ("visdom", "inside")
    assert inner["hull_volume"] == hull["volume"] > inner["volume"] > 0
    assert inner["bounds"] == hull["bounds"] and inner["watertight"] is True
    assert all(inner["coverage"][name] > share - 0.005 for name, share in hull["coverage"].items())
    assert trimesh.load(tmp_path / "inner.ply").volume == pytest.approx(inner["volume"], rel=0.1)
    assert main([*words, "--inside"]) == 0
    assert "of the hull's volume" in capsys.readouterr().out


def test_radius_and_photographs_change_the_shape_inside(scene, capsys):
    def measure(*more):
        assert main(["somewhere", "--resolution", "48", "-k", "2", "--inside", "--json", *more]) == 0
        return json.loads(capsys.readouterr().out)

    plain, round_, seen = measure(), measure("--inside-radius", "1"), measure("--photo-weight", "0.3")
    assert (plain["radius"], plain["photo_weight"]) == (2.0, 0.0)
    assert measure("--inside-radius", "2", "--photo-weight", "0")["volume"] == plain["volume"]
    # The smaller the radius, the more of the corners stays.
    assert round_["volume"] > plain["volume"] and round_["radius"] == 1
    assert seen["volume"] != plain["volume"] and seen["photo_weight"] == 0.3
    assert main(["somewhere", "--photo-weight", "0.15"]) == 2
    assert "add --inside" in capsys.readouterr().err
    for words in (["--inside-radius", "-1"], ["--photo-weight", "nan"]):
        assert main(["somewhere", "--inside", *words]) == 2
        assert f"where: {words[0]}" in capsys.readouterr().err


def test_the_shape_inside_of_what_one_view_sees_is_refused(scene, capsys):
    assert main(["somewhere", "--resolution", "48", "-k", "1", "--inside"]) == 2
    assert "k of 2 or more" in capsys.readouterr().err


def test_test_views_are_read_only_for_masks_seen_by_their_cameras(scene, tmp_path):
    words = ["somewhere", "--resolution", "32", "--quiet"]
    for more in (
        [],
        ["--cameras", "test"],
        *(["--masks-out", str(tmp_path / c), "--cameras", c] for c in CAMERAS),
    ):
        assert main([*words, *more, "--frames", "2"]) == 0
    assert [keywords["test"] for _, keywords in scene] == [False, False, *(c == "test" for c in CAMERAS)]


def test_files_hold_the_hull(scene, tmp_path, capsys):
    assert main(["--resolution", "32", "--out", str(tmp_path / "hull.ply"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    mesh = trimesh.load(tmp_path / "hull.ply", process=False)
    assert mesh.is_watertight and mesh.area == pytest.approx(report["surface_area"], rel=1e-4)
    assert main(["--resolution", "32", "--out", str(tmp_path / "hull.npz"), "--quiet"]) == 0
    hull = Hull.load(tmp_path / "hull.npz")
    assert hull.voxels == report["voxels"] and np.allclose(hull.bounds, report["bounds"])
    assert capsys.readouterr().out == ""
    for ending in ("obj", "glb", "OBJ"):
        assert main(["--resolution", "32", "--out", str(tmp_path / f"hull.{ending}"), "--quiet"]) == 0
        other = trimesh.load(tmp_path / f"hull.{ending}", process=False, force="mesh")
        assert other.is_watertight and other.area == pytest.approx(mesh.area, rel=1e-4)
    names = ["hull.OBJ", "hull.glb", "hull.npz", "hull.obj", "hull.ply"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert main(["--out", str(tmp_path / "hull.stl")]) == 2
    assert ".ply, .obj, .glb (mesh) or .npz" in capsys.readouterr().err


def test_table_and_diagnosis(scene, capsys):
    assert main(["--resolution", "32", "--diagnose", "--kind", "released-go"]) == 0
    shown = capsys.readouterr().out
    for words in (
        "watertight",
        "v3.png",
        "Masks and cameras miss each other",
        "nothing wrong",
        "inside at least 3 of 4 masks",
    ):
        assert words in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-k", "0"], "k is 0"),
        (["--agreement", "2"], "agreement is 2"),
        (["--resolution", "1"], "resolution is 1"),
        (["--out", "hull.stl"], "hull.stl"),
        (["-k", "9"], "than the 4 views"),
        (["one", "--data", "two"], "two scenes"),
        (["--bounds", "0", "0", "0", "0", "1", "1"], "bounds"),
    ],
)
def test_mistakes_exit_with_2_and_a_message(scene, words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json"]) == 2
    shown = capsys.readouterr()
    assert said in shown.err and "what to do" in shown.err and "Traceback" not in shown.err
    assert shown.out == "" and not list(tmp_path.iterdir())


def test_help_needs_no_heavy_import():
    code = (
        "import sys\n"
        "from visdom_plugin.cli.commands.hull import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'numba', 'cv2', 'trimesh', 'skimage', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--min-component-fraction" in done.stdout
