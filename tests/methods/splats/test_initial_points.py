"""Where Gaussians start, by what there is: a hook, a hull, points of structure from motion, cameras alone."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs import corgs_lite, fsgs_lite, gs_go
from visdom_plugin.errors import CheckpointError
from visdom_plugin.geometry.cameras import look_at_point
from visdom_plugin.methods.splats.corgs_lite import CorgsLite
from visdom_plugin.methods.splats.fsgs.method import FsgsLite
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.methods.splats.initial_points import draw_points
from visdom_plugin.registry import Preset
from visdom_plugin.seeding import generator
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import train

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48))


def cloud(views, n=200):
    draw = generator(0, "cloud")
    xyz = look_at_point(views.cameras) + 0.1 * torch.randn(n, 3, generator=draw, dtype=torch.float64)
    return xyz, torch.rand(n, 3, generator=draw)


@pytest.mark.parametrize(
    ("kind", "quick"),
    [(GsGo, gs_go.SPEC.quick), (CorgsLite, corgs_lite.SPEC.quick), (FsgsLite, fsgs_lite.SPEC.quick)],
    ids=["gs_go", "corgs", "fsgs"],
)
def test_without_a_hull_all_methods_start_from_the_scenes_points(kind, quick, scene):
    xyz, rgb = cloud(scene.train)
    method = kind(replace(quick, hull=None))
    method.setup(replace(scene.train, points=(xyz, rgb)), [], hull=None, device=CPU, seed=0)
    splats = method.splats
    torch.testing.assert_close(splats.means, xyz.float())
    dc = splats.optimiser.parameters["sh"].detach()[:, 0]
    torch.testing.assert_close(dc * 0.28209479177387814 + 0.5, rgb)


def test_of_too_many_points_some_are_drawn_the_same_ones_for_one_seed(scene):
    views = replace(scene.train, points=cloud(scene.train))
    first, again, other = (draw_points([], None, views, 50, generator(seed))[0] for seed in (0, 0, 1))
    assert len(first) == 50 and torch.equal(first, again) and not torch.equal(first, other)
    assert all((views.points[0].float() == point).all(-1).any() for point in first)


def test_without_points_they_start_around_what_the_cameras_look_at(scene):
    xyz, _ = draw_points([], None, scene.train, 300, generator(0))
    centre = look_at_point(scene.train.cameras)
    reach = (scene.train.cameras.centres - centre).norm(dim=-1).mean()
    assert len(xyz) == 300 and float((xyz - centre).abs().max()) < 0.33 * float(reach)


def test_a_run_reads_the_scenes_points_only_where_no_hull_is_asked_for(scene, tmp_path, monkeypatch):
    asked = []

    def read():
        asked.append(1)
        return cloud(scene.train)

    small = replace(gs_go.SPEC.quick, steps=2, initial_points=150)
    preset = Preset("3dgs-go", "", "visdom_plugin.methods.splats.gs_go:GsGo", small, small)
    monkeypatch.setattr("visdom_plugin.registry.find", lambda name: preset)
    tiny = replace(scene, test=scene.test.take([0]), read_points=read)
    for i, (config, count) in enumerate(((small, 0), (replace(small, hull=None), 1))):
        one = replace(tiny)
        train("3dgs-go", config, one, data_manager=DataManager, run_dir=tmp_path / str(i), quiet=True)
        assert len(asked) == count


def test_a_run_from_other_points_is_another_run(scene, tmp_path, monkeypatch):
    small = replace(gs_go.SPEC.quick, steps=1, initial_points=50, hull=None)
    preset = Preset("3dgs-go", "", "visdom_plugin.methods.splats.gs_go:GsGo", small, small)
    monkeypatch.setattr("visdom_plugin.registry.find", lambda name: preset)

    def run(xyz, rgb):
        tiny = replace(scene, test=scene.test.take([0]), read_points=lambda: (xyz, rgb))
        return train("3dgs-go", small, tiny, data_manager=DataManager, run_dir=tmp_path / "run", quiet=True)

    xyz, rgb = cloud(scene.train)
    assert not run(xyz, rgb)["already_finished"]
    assert run(xyz.clone(), rgb.clone())["already_finished"]
    for others in ((xyz + 0.01, rgb), (xyz, 1 - rgb), (xyz[1:], rgb[1:])):
        with pytest.raises(CheckpointError, match="another run"):
            run(*others)
