"""visdom-render: sizes, outputs, formats and files of cameras."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.hull.balls import ring
from visdom_plugin.cli.commands import render, train
from visdom_plugin.cli.subject import Subject
from visdom_plugin.figures.contact_sheet import read_png
from visdom_plugin.geometry.camera_paths import framed


@pytest.fixture
def trained(fakes, capsys):
    words = ["method:fake", "--method.steps", "12", "--out", "run", "--quiet", "--no-report"]
    assert train.main(words) == 0
    return Path("run")


def draw(run, *words):
    return render.main([str(run), "--quiet", *words])


def test_depth_and_opacity_lie_beside_the_picture(trained):
    outputs = ["--outputs", "rgb", "depth", "alpha"]
    assert draw(trained, "--frames", "3", "--format", "png", *outputs, "--width", "48") == 0
    folders = {name: trained / "renders" / f"orbit{name}_frames" for name in ("", "_depth", "_alpha")}
    for folder in folders.values():
        assert [p.name for p in sorted(folder.glob("*.png"))] == ["0000.png", "0001.png", "0002.png"]
    opacity = read_png(folders["_alpha"] / "0000.png")
    # The fake method draws a disc of depth 1 in the middle.
    assert opacity.shape == (40, 48, 3) and opacity[0, 0, 0] == 0 and opacity[20, 24, 0] == 255
    depth = np.load(folders["_depth"] / "0000.npy")
    assert depth.dtype == np.float32 and depth.shape == (40, 48) and depth[20, 24] == 1
    coloured = read_png(folders["_depth"] / "0000.png")
    assert (coloured[0, 0] == 255).all() and not (coloured[20, 24] == 255).all()
    # A shorter path takes the rest of the longer one's along, arrays too.
    assert draw(trained, "--frames", "2", "--format", "png", "--outputs", "depth") == 0
    assert len(list(folders["_depth"].iterdir())) == 4


def test_a_format_is_told_by_the_name(trained, capsys):
    assert draw(trained, "--frames", "4", "--out", "turn.gif", "--outputs", "rgb", "alpha") == 0
    for name in ("turn.gif", "turn_alpha.gif"):
        with Image.open(name) as clip:
            assert clip.format == "GIF" and clip.size == (24, 20)
    assert draw(trained, "--frames", "1", "--out", "one.png", "--width", "30", "--height", "10") == 0
    assert read_png(Path("one.png")).shape == (10, 30, 3)
    assert draw(trained, "--format", "gif", "--out", "turn.mp4") == 2
    assert "ends in .gif" in capsys.readouterr().err
    assert draw(trained, "--width", "0") == 2
    assert "--width is 0" in capsys.readouterr().err


def test_the_line_on_the_codec_names_what_is_missing(trained, monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "av", None)
    assert render.main([str(trained), "--frames", "2"]) == 0
    said = capsys.readouterr().err
    assert "2 frames of 24 x 20, 0.1 s of video, codec mp4v" in said and "visdom-plugin[video]" in said


def test_a_file_of_cameras_is_followed(trained, capsys):
    cameras = [{"position": p, "look_at": [0, 0, 0], "fov": 40} for p in ([2, 0, 1], [0, 2, 1])]
    Path("way.json").write_text(json.dumps({"camera_path": cameras, "render_width": 32, "render_height": 16}))
    assert draw(trained, "--path", "way.json", "--format", "png") == 0
    folder = trained / "renders" / "way_frames"
    assert len(list(folder.iterdir())) == 2 and read_png(folder / "0000.png").shape == (16, 32, 3)
    assert draw(trained, "--path", "way.json", "--format", "png", "--frames", "9", "--width", "64") == 0
    assert len(list(folder.iterdir())) == 9 and read_png(folder / "0000.png").shape == (32, 64, 3)
    Path("way.json").write_text("{}")
    assert draw(trained, "--path", "way.json", "--out", "way.mp4") == 2
    assert "camera_path" in capsys.readouterr().err and not Path("way.mp4").exists()


@pytest.mark.parametrize(
    ("method", "longest", "drawn"),
    [
        ("visdom-gs", 100, 640),
        ("visdom-gs", 800, 800),
        ("3dgs-go+vd", 4032, 1280),
        (None, 200, 640),
        ("ingp+vd", 200, 200),
        ("zipnerf-lite", 1600, 480),
    ],
)
@pytest.mark.parametrize("tall", [False, True])
def test_a_first_look_is_large_where_that_costs_little(method, longest, drawn, tall):
    sizes = (3 * longest // 4, longest) if tall else (longest, 3 * longest // 4)
    camera = ring(1).resized(torch.tensor([sizes[0]]), torch.tensor([sizes[1]]))
    subject = Subject(None, None, None, torch.device("cpu"), method and {"method": method})
    asked = {"run": Path("run"), "path": "orbit"}
    chosen = framed(camera, *render._choose_size(render.Options(**asked), subject, camera))
    assert max(int(chosen.width), int(chosen.height)) == drawn
    assert min(int(chosen.width), int(chosen.height)) == round(0.75 * drawn)
    for more in ({"width": 50}, {"height": 50}, {"path": "train"}):
        options = render.Options(**asked | more)
        assert render._choose_size(options, subject, camera) == (options.width, options.height)


def test_an_orbit_lasts_five_seconds(trained, capsys):
    assert render.main([str(trained)]) == 0
    assert "120 frames of 24 x 20, 5.0 s of video" in capsys.readouterr().err
