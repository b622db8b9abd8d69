"""Gaussians keep their look when they are moved, and their numbers in every file format."""

import math

import numpy as np
import pytest
import torch

from tests.splat.twin import make_gaussians
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.export import splat_files, splats
from visdom_plugin.export.spz import read_spz, write_spz
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.splat.ply import write_gaussians
from visdom_plugin.splat.rasterise import rasterise


def motion_of(quaternion, translation) -> torch.Tensor:
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = matrix_from_quaternion(torch.tensor(quaternion, dtype=torch.float64))
    motion[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return motion


def camera_at(motion=None) -> Cameras:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -4
    pose = pose if motion is None else motion @ pose
    K = torch.tensor([[60.0, 0, 24], [0, 60, 18], [0, 0, 1]])
    return Cameras(K, pose.float(), torch.tensor(48), torch.tensor(36))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_camera_that_moves_with_the_gaussians_sees_the_same(degree):
    gaussians = make_gaussians(n=30, degree=degree, dtype=torch.float32).detach()
    motion = motion_of([0.3, -0.5, 0.7, 0.2], [0.4, -1.0, 2.0])
    before = rasterise(gaussians, camera_at(), torch.ones(3), near=0.01).rgb
    after = rasterise(splats.move(gaussians, motion), camera_at(motion), torch.ones(3), near=0.01).rgb
    assert before.std() > 0.01
    assert (before - after).abs().max() < 2e-4


def test_turning_harmonics_twice_is_turning_them_by_the_product():
    a, b = (motion_of(q, [0, 0, 0])[:3, :3] for q in ([1, 2, 3, 4], [-1, 0.5, 2, 0.1]))
    once, twice, both = (splats.turn_harmonics(r, 3) for r in (a, b, b @ a))
    assert torch.allclose(twice @ once, both, atol=1e-9)


def test_crop_keeps_what_is_inside():
    gaussians = make_gaussians(n=40, dtype=torch.float32).detach()
    kept = splats.crop(gaussians, lambda x: x[:, 0] > 0)
    assert len(kept) == int((gaussians.means[:, 0] > 0).sum()) and (kept.means[:, 0] > 0).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_spz_rounds_and_nothing_more(tmp_path, degree, scale):
    gaussians = make_gaussians(n=50, degree=degree, dtype=torch.float32).detach()
    gaussians.means *= scale
    write_spz(tmp_path / "a.spz", gaussians)
    back = read_spz(tmp_path / "a.spz")
    assert (back.means - gaussians.means).abs().max() <= 1e-6 * gaussians.means.abs().max() + 2**-20
    assert (back.log_scales - gaussians.log_scales.clamp(-10, 6)).abs().max() < 1 / 31
    turned, straight = (matrix_from_quaternion(g.quaternions) for g in (back, gaussians))
    assert (turned - straight).abs().max() < 0.01
    assert (back.opacity_logits.sigmoid() - gaussians.opacity_logits.sigmoid()).abs().max() < 1 / 500
    small = gaussians.sh[:, 1:].abs() < 0.9
    assert ((back.sh[:, 1:] - gaussians.sh[:, 1:]).abs() < 1 / 128 + 1e-4)[small].all()


def test_other_libraries_read_our_spz(tmp_path):
    gsply = pytest.importorskip("gsply")
    gaussians = make_gaussians(n=50, degree=2, dtype=torch.float32).detach()
    write_spz(tmp_path / "a.spz", gaussians)
    theirs, ours = gsply.read_spz(tmp_path / "a.spz"), read_spz(tmp_path / "a.spz")
    # That library leaves the file's axes, y up, as they are.
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    ours = splats.move(ours, flip)
    assert np.allclose(theirs.means, ours.means, atol=1e-5)
    assert np.allclose(theirs.scales, ours.log_scales, atol=1e-5)
    same = np.abs((np.asarray(theirs.quats) * ours.quaternions.numpy()).sum(1))
    assert np.allclose(same, 1, atol=1e-3)
    assert np.allclose(theirs.sh0, ours.sh[:, 0], atol=1e-4)
    assert np.allclose(theirs.shN, ours.sh[:, 1:], atol=1e-4)


def test_other_libraries_read_our_ply(tmp_path):
    plyfile, gsply = pytest.importorskip("plyfile"), pytest.importorskip("gsply")
    gaussians = make_gaussians(n=20, degree=3, dtype=torch.float32).detach()
    write_gaussians(tmp_path / "a.ply", gaussians)
    content = plyfile.PlyData.read(tmp_path / "a.ply")
    assert "SplatRenderMode: default" in content.comments
    assert np.array_equal(content["vertex"]["opacity"], gaussians.opacity_logits.numpy())
    theirs = gsply.plyread(tmp_path / "a.ply")
    assert np.array_equal(theirs.means, gaussians.means) and np.array_equal(theirs.shN, gaussians.sh[:, 1:])


def test_splat_files_keep_what_the_format_holds(tmp_path):
    gaussians = make_gaussians(n=30, degree=1, dtype=torch.float32).detach()
    splat_files.write_splats(tmp_path / "a.splat", gaussians)
    back = splat_files.read_splats(tmp_path / "a.splat")
    order = torch.argsort(
        gaussians.log_scales.double().sum(1).exp() * gaussians.opacity_logits.double().sigmoid(),
        descending=True,
    )
    assert (tmp_path / "a.splat").stat().st_size == 32 * 30
    assert torch.allclose(back.means, gaussians.means[order])
    assert torch.allclose(back.log_scales, gaussians.log_scales[order], atol=1e-5)
    turned, straight = (matrix_from_quaternion(q) for q in (back.quaternions, gaussians.quaternions[order]))
    assert (turned - straight).abs().max() < 0.03
    assert back.sh.shape == (30, 1, 3)


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.ply"])
def test_damaged_files_are_refused(tmp_path, name):
    splat_files.write_splats(tmp_path / name, make_gaussians(n=9, dtype=torch.float32).detach())
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[:-7])
    with pytest.raises(SceneError):
        splat_files.read_splats(tmp_path / name)


def test_without_node_the_command_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    gaussians = make_gaussians(n=5, dtype=torch.float32).detach()
    with pytest.raises(ConfigError, match="splat-transform") as caught:
        splat_files.write_splats(tmp_path / "a.sog", gaussians)
    assert "npx @playcanvas/splat-transform" in str(caught.value) and "a.sog" in str(caught.value)
    assert not (tmp_path / "a.sog").exists()


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A stand-in for splat-transform: what it is handed is copied to what it is to write."""
    tool = tmp_path / "bin" / "splat-transform"
    tool.parent.mkdir()
    tool.write_text('#!/bin/sh\nfor last; do before=$prev; prev=$last; done\ncp "$before" "$last"\n')
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tool.parent}:/usr/bin:/bin")


def test_sog_is_made_by_splat_transform(tmp_path, stand_in):
    gaussians = make_gaussians(n=5, dtype=torch.float32).detach()
    splat_files.write_splats(tmp_path / "a.sog", gaussians, torch.tensor([5.0, 0, 0], dtype=torch.float64))
    (tmp_path / "a.sog").rename(tmp_path / "b.ply")
    back = splat_files.read_splats(tmp_path / "b.ply")
    assert torch.allclose(back.means, gaussians.means + torch.tensor([5.0, 0, 0]))


def test_description_of_a_file(tmp_path):
    gaussians = make_gaussians(n=25, degree=2, dtype=torch.float32).detach()
    write_gaussians(tmp_path / "a.ply", gaussians)
    about = splat_files.describe(tmp_path / "a.ply")
    assert about["gaussians"] == 25 and about["degree"] == 2
    assert about["bounds"][1] == gaussians.means.double().amax(0).tolist()
    assert math.isclose(about["scale_largest"], float(gaussians.log_scales.exp().max()), rel_tol=1e-5)
    assert "SplatRenderMode: default" in about["comments"]


@pytest.mark.parametrize("kind", ["spz", "splat", "sog", "html"])
def test_map_coordinates_are_refused_where_a_format_would_round_them(tmp_path, kind):
    gaussians = make_gaussians(40)
    with pytest.raises(ConfigError, match=r"(?s)5e\+06|5000.*map coordinates.*--upright"):
        shift = torch.tensor([5e6, 0, 0], dtype=torch.float64)
        splat_files.write_splats(tmp_path / f"far.{kind}", gaussians, shift)
    assert not list(tmp_path.iterdir())


def test_map_coordinates_stay_from_file_to_file(tmp_path):
    gaussians = make_gaussians(40, dtype=torch.float32).detach()
    shift = torch.tensor([5e6, -4e6, 100.0], dtype=torch.float64)
    write_gaussians(tmp_path / "far.ply", gaussians, shift)
    near, origin = splat_files.read_near(tmp_path / "far.ply")
    assert torch.allclose(near.means + origin, gaussians.means + shift, rtol=0, atol=1e-6)
    about = splat_files.describe(tmp_path / "far.ply")
    assert np.allclose(about["bounds"][0], (gaussians.means.double() + shift).amin(0), rtol=0, atol=1e-6)
    # Near the origin nothing is moved.
    write_gaussians(tmp_path / "near.ply", gaussians)
    near, origin = splat_files.read_near(tmp_path / "near.ply")
    assert not origin.any() and torch.equal(near.means, gaussians.means)
