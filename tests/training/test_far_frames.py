"""Laws of translation: a capture trains alike wherever its frame's origin lies, and its files come out there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.errors import CheckpointError
from visdom_plugin.geometry.local_frame import local_origin
from visdom_plugin.splat.ply import read_ply
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.local_method import ORIGIN, LocalMethod, move_near
from visdom_plugin.training.run import build, choose_batches, export

CPU = torch.device("cpu")
FAR = pytest.mark.parametrize("far", [1e5, 5e6])
VARIANTS = (
    "ingp+vd",
    "zipnerf-lite+vd",
    "zerorf-lite+vd",
    "3dgs-go+vd",
    "corgs-lite+vd",
    "fsgs-lite+vd",
    "splatfields-lite+vd",
)
STEPS = 6


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48, test_views=2))


def shift_of(far: float) -> torch.Tensor:
    return torch.tensor([far, -0.7 * far, 0.31 * far + 0.25], dtype=torch.float64)


def moved(scene, far: float):
    """The scene as a survey would hand it over: all cameras `far` from the origin."""
    train, test = (
        replace(views, cameras=views.cameras.relative_to(-shift_of(far)))
        for views in (scene.train, scene.test)
    )
    return replace(scene, train=train, test=test)


def begin(name: str, scene):
    """The method as a run sets it up, small, and its batches."""
    preset = registry.find(name)
    config = replace(preset.quick, hull=replace(preset.quick.hull, resolution=64))
    small = {
        "initial_points": 400,
        "max_rays": 256,
        "rays": 128,
        "first_rays": 64,
        "noise_resolution": 2,
        "samples_per_step": 1 << 11,
        "density_bias": 0.0,
        # At the preset's rate Adam makes a difference of one part in ten million one of 0.001 in three steps.
        "lr_field": 4e-4,
    }
    config = replace(config, **{k: v for k, v in small.items() if hasattr(config, k)})
    method, hull, _ = build(preset, config, scene.train, device=CPU, seed=0)
    return method, hull, choose_batches(method, DataManager(move_near(scene.train), 0))


def train(name: str, scene):
    """After a few steps: the method, its losses, and a test view's render."""
    method, _, batches = begin(name, scene)
    losses = []
    for step in range(STEPS):
        output = method.train_step(batches(step), step)
        total = sum(output.losses.values())
        total.backward()
        method.optimise(step, output)
        losses.append(float(total.detach()))
    return method, losses, method.render(scene.test.cameras[0], torch.ones(3))


@FAR
def test_training_rays_meet_the_hull_alike(scene, far):
    near_end, far_end = [], []
    for here, kept in ((scene, near_end), (moved(scene, far), far_end)):
        method, _, batches = begin("ingp+vd", here)
        (hook,) = method.hooks
        for step in range(8):
            batch = batches(step)
            n = len(batch.mask)
            kept.append(hook.bound(batch.origins, batch.directions, torch.zeros(n), torch.full((n,), 99.0)))
    near, there = (tuple(torch.cat(x) for x in zip(*kept, strict=True)) for kept in (near_end, far_end))
    assert 0.1 < near[2].float().mean() < 0.9
    # A ray that grazes a voxel's edge may fall to either side.
    same = near[2] == there[2]
    assert (~same).sum() <= 1
    for a, b in zip(near[:2], there[:2], strict=True):
        assert ((a - b).abs() < 1e-4 * 99)[same].float().mean() > 0.995


@FAR
@pytest.mark.parametrize("name", VARIANTS)
def test_a_method_trains_alike(scene, name, far):
    method, losses, render = train(name, scene)
    far_method, far_losses, far_render = train(name, moved(scene, far))
    assert not isinstance(method, LocalMethod) and isinstance(far_method, LocalMethod)
    assert far_losses == pytest.approx(losses, rel=2e-3)
    for field in ("rgb", "alpha"):
        difference = (getattr(render, field) - getattr(far_render, field)).abs()
        assert difference.mean() < 1e-3 and difference.max() < 0.1
    assert 0.01 < render.alpha.mean() < 0.99


@FAR
@pytest.mark.parametrize("name", ["3dgs-go+vd", "corgs-lite+vd"])
def test_gaussians_are_exported_where_the_capture_is(scene, name, far, tmp_path):
    means = []
    for here in (scene, moved(scene, far)):
        method, hull, _ = begin(name, here)
        (path,) = export(method, tmp_path)
        points = trimesh.load(path).vertices  # any reader of PLY
        assert hull.contains(torch.from_numpy(np.asarray(points)), margin_voxels=1).all()
        means.append(np.asarray(points))
        local = read_ply(path, local_origin(here.train.cameras)).means
        inner = getattr(method, "method", method)
        splats = inner.sets[0] if name.startswith("corgs") else inner.splats
        assert (local - splats.means).abs().max() < 1e-6
    assert np.abs(means[0] + shift_of(far).numpy() - means[1]).max() < 1e-4


@FAR
def test_meshes_are_exported_where_the_capture_is(scene, far, tmp_path):
    vertices = []
    for here in (scene, moved(scene, far)):
        method, hull, _ = begin("ingp+vd", here)
        inner = getattr(method, "method", method)
        inner.density = lambda points: 100.0 * (points.norm(dim=-1) < 0.3)
        inner.occupancy.is_occupied = lambda points: torch.ones(len(points), dtype=torch.bool)
        (path,) = export(method, tmp_path)
        mesh = trimesh.load(path, process=False)
        assert mesh.is_watertight and mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)
        vertices.append(np.asarray(mesh.vertices))
        hull.write_ply(tmp_path / "hull.ply")
        outline = np.asarray(trimesh.load(tmp_path / "hull.ply", process=False).vertices)
        assert np.abs(outline - hull.to_mesh()[0]).max() < 1e-6
    assert np.abs(vertices[0] + shift_of(far).numpy() - vertices[1]).max() < 1e-4


def test_near_the_origin_nothing_moves(scene):
    for shift in (0.0, 100.0):
        views = moved(scene, shift).train
        assert move_near(views) is views
    origin = move_near(moved(scene, 5e6).train).origin
    assert ((origin - shift_of(5e6)).abs() < 10).all() and torch.equal(origin, origin.round())


def test_a_checkpoint_knows_its_frame(scene):
    there = moved(scene, 1e5)
    method, _, _ = begin("3dgs-go+vd", there)
    state = method.state_dict()
    assert torch.equal(state[ORIGIN], local_origin(there.train.cameras))
    method.load_state_dict(state)
    for wrong in ({k: v for k, v in state.items() if k != ORIGIN}, state | {ORIGIN: state[ORIGIN] + 10}):
        with pytest.raises(CheckpointError, match="origin"):
            method.load_state_dict(wrong)
