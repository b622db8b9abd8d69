"""Masks on the command line: those made of a hull, and what becomes of views that have none."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, ring
from tests.training import fake
from visdom_plugin.cli.commands import check, evaluate, hull, train
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.scene import Scene, Views

BALL = [((0.1, 0, 0), 0.5)]
SMALL = ["somewhere", "--resolution", "32", "--quiet"]


def views_of(cameras, prefix):
    masks = ball_masks(cameras, BALL)
    names = [f"{prefix}/v{i}.jpg" for i in range(len(masks))]
    return Views(cameras, [m[..., None].expand(*m.shape, 3) for m in masks], masks, names)


@pytest.fixture
def scene(monkeypatch, tmp_path):
    import datamodules

    made = Scene("ball", views_of(ring(4, size=48), "a"), views_of(ring(3, size=40, seed=5), "b"))
    holder = {"scene": made}
    monkeypatch.setattr(datamodules, "load", lambda path, **keywords: holder["scene"], raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "somewhere").mkdir()
    return holder


def read(path):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint8 and image.ndim == 2 and set(np.unique(image)) <= {0, 255}
    return image > 0


@pytest.mark.parametrize("which", ["train", "test"])
def test_masks_of_the_scenes_cameras_are_the_hulls_outlines(scene, which):
    assert hull.main([*SMALL, "--masks-out", "out/m", "--cameras", which]) == 0
    views = getattr(scene["scene"], which)
    carved = VisibleDomain(resolution=32).carve(*scene["scene"].train.silhouettes())
    files = sorted(Path("out/m").iterdir())
    assert [f.name for f in files] == [n.replace("/", "_").replace("jpg", "png") for n in views.names]
    for i, path in enumerate(files):
        assert np.array_equal(read(path), depth_and_silhouette(carved, views.cameras[i])[1].numpy())


def test_masks_on_an_orbit_come_with_their_cameras(scene):
    assert hull.main([*SMALL, "--masks-out", "o", "--cameras", "orbit", "--frames", "5"]) == 0
    described = json.loads(Path("o/transforms.json").read_text())
    assert len(described["frames"]) == 5 and len(list(Path("o").iterdir())) == 6
    carved = VisibleDomain(resolution=32).carve(*scene["scene"].train.silhouettes())
    for frame in described["frames"]:
        K = [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        camera = Cameras.from_matrices(
            torch.tensor(K, dtype=torch.float64),
            torch.tensor(frame["transform_matrix"], dtype=torch.float64),
            width=frame["w"],
            height=frame["h"],
            convention="opengl",
        )
        mask = read(Path("o") / frame["file_path"])
        assert np.array_equal(mask, depth_and_silhouette(carved, camera)[1].numpy()) and mask.any()
        # The circle's axis goes through the hull's centre: it is seen near the principal point.
        row, column = np.nonzero(mask)
        assert abs(column.mean() + 0.5 - frame["cx"]) < 2 and abs(row.mean() + 0.5 - frame["cy"]) < 3


def test_files_that_are_there_are_left_alone(scene, capsys):
    Path("m").mkdir()
    Path("m/b_v1.png").write_bytes(b"by hand")
    command = [*SMALL, "--masks-out", "m", "--cameras", "test"]
    assert hull.main(command) == 2
    assert "b_v1.png is there already" in capsys.readouterr().err
    assert [p.name for p in Path("m").iterdir()] == ["b_v1.png"]
    assert hull.main([*command, "--overwrite"]) == 0
    assert read(Path("m/b_v1.png")).any()
    Path("file").write_text("")
    assert hull.main([*SMALL, "--masks-out", "file/m"]) == 2


def strip(views, without):
    origins = ["missing" if i in without else "given" for i in range(len(views))]
    return replace(views, mask_origins=origins, masks=[m | (i in without) for i, m in enumerate(views.masks)])


def test_a_view_without_a_mask_gets_the_others_hull(scene, capsys):
    """With `--cameras train`, the mask that is written for a view that has none is made of the others alone."""
    bare = scene["scene"]
    scene["scene"] = replace(bare, train=strip(bare.train, {2}))
    flags = ["--masks-out", "m", "--cameras", "train", "--data.missing-masks", "hull"]
    assert hull.main(["somewhere", "--resolution", "32", *flags]) == 0
    out = capsys.readouterr().out
    assert "3 foreground masks" in out and "1 view without a mask" in out and "a/v2.jpg" not in out
    keep = [0, 1, 3]
    carved = VisibleDomain(resolution=32).carve(bare.train.cameras[keep], [bare.train.masks[i] for i in keep])
    mask = read(Path("m/a_v2.png"))
    assert np.array_equal(mask, depth_and_silhouette(carved, bare.train.cameras[2])[1].numpy())


@pytest.fixture
def bare_fakes(fakes, monkeypatch):
    """The fake method on a scene one of whose training views has no mask."""
    import datamodules

    def load(path, **keywords):
        fakes.append((path, keywords))
        whole = fake.tiny_scene()
        return replace(whole, train=strip(whole.train, {1}))

    monkeypatch.setattr(datamodules, "load", load, raising=False)
    return fakes


@pytest.mark.parametrize("way", ["colour", "hull"])
def test_training_says_what_it_does_without_a_mask_and_remembers_it(bare_fakes, capsys, way):
    command = ["method:fake", "--method.steps", "6", "--out", "run"]
    assert train.main(command) == 2
    assert "--data.missing-masks colour|hull" in capsys.readouterr().err
    assert train.main([*command, "--data.missing-masks", way]) == 0
    err = capsys.readouterr().err
    assert "data: 3 foreground masks" in err and "hull" in err
    assert json.loads(Path("run/run.json").read_text())["data"]["missing_masks"] == way
    assert evaluate.main(["run", "--quiet"]) == 0
    assert all(keywords.get("allow_missing_masks") for _, keywords in bare_fakes[1:])
    assert train.main([*command, "--data.missing-masks", {"hull": "colour", "colour": "hull"}[way]]) == 2
    assert "missing_masks" in capsys.readouterr().err


@pytest.mark.parametrize(("without", "title"), [({1}, "2 of 3 test views"), ({0, 1, 2}, "0 of 3 test views")])
def test_how_many_test_views_were_measured_is_said_and_noted(
    fakes, monkeypatch, capsys, caplog, without, title
):
    import datamodules

    whole = fake.tiny_scene()
    gap = replace(whole, test=strip(whole.test, without))
    monkeypatch.setattr(datamodules, "load", lambda path, **keywords: gap, raising=False)
    command = ["method:fake", "--method.steps", "6", "--out", "run", "--data.missing-masks", "hull"]
    for run in (lambda: train.main(command), lambda: evaluate.main(["run"])):
        caplog.clear()
        assert run() == 0
        out = capsys.readouterr().out
        assert (
            f"fake on ball, {title}" in out
            and f"test views without a mask, {len(without)} of 3" in caplog.text
        )
        assert ("no test view has a mask of its own" in out) == (len(without) == 3) == ("PSNR" not in out)
        found = json.loads(Path("run/run.json").read_text())["metrics"]
        assert found["measured_views"] == 3 - len(without)
        assert (found["test"]["psnr"] is None) == (len(without) == 3)
        origins = [row.get("mask_origin") for row in found["per_view"].values()]
        assert origins == ["missing" if i in without else None for i in range(3)]
        assert len(list(Path("run/renders/test").iterdir())) == 3


def test_the_options_of_a_file_and_of_the_command_line_agree(fakes, capsys):
    assert (
        train.main(
            ["method:fake", "--data.missing-masks", "hull", "--data.mask-source=alpha", "--show-config"]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert "missing_masks: hull" in text and "mask_source: alpha" in text
    Path("my.yaml").write_text(text)
    assert train.main(["--config", "my.yaml", "--show-config"]) == 0
    assert capsys.readouterr().out == text


@pytest.mark.parametrize("command", ["check", "hull"])
def test_no_mask_at_all_is_said_in_the_commands_terms(scene, command, capsys):
    made = scene["scene"]
    scene["scene"] = replace(made, train=replace(made.train, mask_origins=("missing",) * 4))
    main = {"check": check.main, "hull": hull.main}[command]
    assert main(["somewhere", "--data.missing-masks", "colour", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "none of the 4 training views has a foreground mask" in said and "masks/<photograph>.png" in said
    assert "--views" not in said and "cameras[None]" not in said
