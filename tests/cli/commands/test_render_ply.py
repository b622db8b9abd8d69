"""Point clouds of Gaussians, whoever trained them, are drawn with a scene's cameras."""

import numpy as np
import pytest
import torch

from datamodules import load
from tests.splat.twin import make_gaussians
from visdom_plugin.cli import subject
from visdom_plugin.cli.commands import render
from visdom_plugin.figures.contact_sheet import read_png, to_bytes
from visdom_plugin.geometry.local_frame import local_origin
from visdom_plugin.splat.ply import read_ply, write_gaussians
from visdom_plugin.splat.rasterise import rasterise

SMALL = ["--views", "3", "--downscale", "4", "--device", "cpu", "--format", "png"]


@pytest.fixture
def cloud(tmp_path):
    write_gaussians(tmp_path / "Überall.ply", make_gaussians(n=30, dtype=torch.float32).detach())
    return tmp_path / "Überall.ply"


@pytest.mark.parametrize(("path", "count"), [("train", 3), ("orbit", 2), ("between", 2)])
def test_pictures_are_those_of_the_rasteriser(cloud, path, count, capsys):
    assert render.main([str(cloud), "--path", path, "--frames", "2", *SMALL, "--width", "50"]) == 0
    folder = cloud.with_name(f"Überall_{path}_frames")
    assert capsys.readouterr().out.strip() == str(folder)
    pictures = sorted(folder.iterdir())
    assert [p.name for p in pictures] == [f"{i:04d}.png" for i in range(count)]
    scene = load(None, views=3, downscale=4, seed=0)
    cameras, _ = render.cameras_along(path, 2, scene, None)
    for i, picture in enumerate(pictures):
        drawn = rasterise(read_ply(cloud), cameras[i], torch.ones(3), near=0.01).rgb
        assert np.array_equal(read_png(picture), to_bytes(drawn))
        assert read_png(picture).std() > 1


@pytest.mark.parametrize("far", [1e5, 5e6])
def test_a_cloud_far_from_the_origin_looks_the_same(cloud, far):
    near = read_ply(cloud)
    cameras = load(None, views=3, downscale=4, seed=0).train.cameras
    shift = torch.tensor([far, -far, 0.5 * far], dtype=torch.float64)
    write_gaussians(cloud, near, shift)
    moved = cameras.relative_to(-shift)
    origin = local_origin(moved)
    there = subject.PointCloud(read_ply(cloud, origin), origin, near=0.01)
    white = torch.ones(3)
    for i in range(len(cameras)):
        drawn, wanted = there.render(moved[i], white), rasterise(near, cameras[i], white)
        assert wanted.alpha.max() > 0.1
        assert (drawn.rgb - wanted.rgb).abs().max() < 1e-3


def test_a_video_lies_beside_the_file(cloud):
    assert render.main([str(cloud), "--frames", "2", *SMALL[:6], "--quiet"]) == 0
    assert cloud.with_name("Überall_orbit.mp4").stat().st_size > 100


def lost(path):
    gaussians = make_gaussians(n=5, dtype=torch.float32).detach()
    gaussians.means[2, 1] = float("nan")
    write_gaussians(path, gaussians)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: None, "cannot read the point cloud: No such file"),
        (lambda path: path.write_bytes(b"solid"), "not a PLY point cloud"),
        (lambda path: path.write_bytes(path.with_name("Überall.ply").read_bytes()[:-7]), "ends after"),
        (
            lambda path: path.write_bytes(
                b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n"
            ),
            "a mesh or a plain point cloud, not one of Gaussians",
        ),
        (lost, "1 of the 5 Gaussians have no finite place"),
    ],
)
def test_what_is_no_cloud_of_gaussians_is_one_clear_error(cloud, make, says, capsys):
    path = cloud.with_name("other.ply")
    make(path)
    assert render.main([str(path), *SMALL]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and says in said and str(path) in said and "Traceback" not in said
    assert not list(cloud.parent.glob("*_frames"))


def test_a_run_is_read_as_it_was(tmp_path, capsys):
    assert render.main([str(tmp_path), "--views", "7"]) == 2
    assert "read as it was for its training" in capsys.readouterr().err
