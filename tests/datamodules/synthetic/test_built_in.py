"""The built-in scenes by name: closed surfaces, exact masks, the same numbers every time, and every command's."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from datamodules import built_in, load
from datamodules.synthetic.catalogue import find_object
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.render import rasterise
from datamodules.synthetic.scene import make_scene
from datamodules.synthetic.solids import ball, join, limb, slab
from visdom_plugin.cli import options
from visdom_plugin.cli.commands import check, export, hull, train
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import project
from visdom_plugin.training.runs.run_directory import hash_views

OTHERS = sorted(set(built_in.NAMES) - {built_in.DEFAULT})
HOLES = {"duck": 0, "figure": 1, "chair": 9}
"""Handles of each surface: round the arm at the hip; between posts, rungs, arms, spindles, seat and rail."""


def solid_of(name: str) -> trimesh.Trimesh:
    shape = find_object(name).shape
    return trimesh.Trimesh(shape.vertices, shape.faces, process=False)


@pytest.mark.parametrize("name", OTHERS)
def test_a_surface_is_one_closed_piece_with_its_holes_standing_on_the_table(name):
    solid = solid_of(name)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0
    assert solid.area_faces.min() > 0 and len(np.unique(solid.faces)) == len(solid.vertices)
    assert solid.body_count == 1 and solid.euler_number == 2 - 2 * HOLES[name]
    assert abs(solid.bounds[0, 2]) < 0.02 and 1.2 < solid.bounds[1, 2] < 1.6


@pytest.mark.parametrize("name", OTHERS)
def test_photographs_masks_and_views_are_made_as_those_of_the_first_scene(name):
    first, scene = (make_scene(SyntheticConfig(size=48, train_views=6), n) for n in (built_in.DEFAULT, name))
    assert scene.name == name and first.name == "built-in"
    assert torch.equal(scene.train.cameras.world_from_camera, first.train.cameras.world_from_camera)
    assert scene.train.names == first.train.names and scene.test.names == first.test.names
    for views, i in ((scene.train, 2), (scene.test, 5)):
        uv, depth = project(views.cameras[i], scene.mesh[0])
        seen = rasterise(uv.numpy(), depth.numpy(), scene.mesh[1].numpy(), 48, 48)
        assert np.array_equal(seen.sample, np.flatnonzero(views.masks[i].numpy().ravel()))
        # On its colours the object is told from table and room.
        assert views.images[i][views.masks[i]].float().std(0).min() > 10
    uv, _ = project(scene.test.cameras, scene.mesh[0])
    assert ((uv > 0) & (uv < 48)).all()


def test_the_first_scene_is_what_it_was():
    """Runs and tables are compared with those of earlier versions."""
    for data in (None, "builtin:watering-can"):
        scene = load(data, views=4)
        assert (hash_views(scene.train)[:16], hash_views(scene.test)[:16]) == (
            "1f45489200847782",
            "cbe01c1811c928b9",
        )


@pytest.mark.parametrize("name", OTHERS)
def test_equal_names_give_equal_bits(name):
    one, two = (load(f"builtin:{name}", views=4, downscale=4) for _ in range(2))
    assert hash_views(one.train) == hash_views(two.train) and hash_views(one.test) == hash_views(two.test)


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("views", [4, 9])
def test_the_check_finds_nothing(name, views, capsys):
    assert check.main([f"builtin:{name}", "--views", str(views)]) == 0
    assert "nothing wrong" in capsys.readouterr().out


def test_gloss_moves_with_the_camera_and_cloth_does_not():
    moved = {}
    for name in ("duck", "figure"):
        thing = find_object(name)
        shape = thing.shape
        points, normals = (x[shape.faces[:, 0]].astype(np.float32) for x in (shape.vertices, shape.normals))
        ways = [
            np.broadcast_to(np.float32(way), points.shape) for way in ((-0.6, 0.0, -0.8), (0.0, -0.6, -0.8))
        ]
        one, two = (thing.paint(points, normals, shape.parts, way) for way in ways)
        moved[name] = np.abs(one - two).max()
    assert moved["figure"] == 0 and moved["duck"] > 0.5


def test_help_lists_every_built_in_scene_and_an_unknown_name_is_answered_with_all(capsys):
    with pytest.raises(SystemExit):
        train.main(["method:ingp", "--help"])
    listed = set(re.findall(r"builtin:([\w-]+\w)", re.sub(r"-?\s*\n[│\s]*", "", capsys.readouterr().out)))
    told = options.SceneOptions.__doc__ or ""
    source = Path(options.__file__).read_text(encoding="utf-8")
    assert told and set(re.findall(r"builtin:([\w-]+)", source)) == set(built_in.NAMES)
    assert "duck" in listed
    assert train.main(["method:ingp", "--data", "builtin:duk"]) == 2
    said = capsys.readouterr().err
    assert "did you mean 'builtin:duck'" in said and "builtin:chair" in said
    with pytest.raises(ConfigError, match="builtin:figure"):
        load("builtin:")
    assert train.main(["method:ingp", "--data", "builtin:duck", "--masks", "x"]) == 2
    assert "drawn, not read from files" in capsys.readouterr().err


def test_a_run_is_opened_again_and_a_data_set_written(tmp_path, monkeypatch, capsys):
    import visdom_plugin as vd

    monkeypatch.chdir(tmp_path)
    words = ["--downscale", "10", "--method.steps", "2", "--device", "cpu", "--quiet", "--no-report"]
    assert train.main(["method:ingp", "--data", "builtin:figure", *words]) == 0
    run = vd.open_run("runs/figure/4/ingp/0")
    assert run.record["data"]["path"] == "builtin:figure" and run.scene.name == "figure"
    assert (
        hull.main(["builtin:duck", "--downscale", "10", "--resolution", "32", "--out", "h.ply", "--quiet"])
        == 0
    )
    assert export.main(["builtin:chair", "--downscale", "10", "--format", "dataset", "--quiet"]) == 0
    assert (tmp_path / "chair_dataset/transforms.json").is_file()


def test_solids_that_touch_become_one_surface_of_the_right_size():
    """A ball, a capsule and a box apart from one another have their volumes; blended, more than their union."""

    def made(*solids):
        shape = join(solids, ("a",), 0.04)
        return trimesh.Trimesh(shape.vertices, shape.faces, process=False)

    assert abs(made(ball("a", (1, 2, 3), 0.5)).volume / (np.pi / 6) - 1) < 0.02
    capsule = made(limb("a", (0, 0, 0), (0, 1, 0), (0.3, 0.3)))
    assert abs(capsule.volume / (np.pi * 0.09 + 4 / 3 * np.pi * 0.027) - 1) < 0.02
    assert abs(made(slab("a", (0, 0, 0), (0.5, 0.4, 0.3), 0.01)).volume / 0.48 - 1) < 0.02
    apart = made(ball("a", (0, 0, 0), 0.3), ball("a", (2, 0, 0), 0.3))
    assert apart.body_count == 2 and apart.is_watertight
    crease, blended = (made(ball("a", (0, 0, 0), 0.3), ball("a", (0.5, 0, 0), 0.3, b)) for b in (0.0, 0.2))
    assert crease.body_count == blended.body_count == 1
    assert blended.volume > 1.02 * crease.volume
