"""Law of units: a capture trains alike whatever the unit of its positions."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.evaluate import carve_reference, evaluate
from visdom_plugin.training.run import build, choose_batches

CPU = torch.device("cpu")
VARIANTS = (
    "ingp+vd",
    "zipnerf-lite+vd",
    "zerorf-lite+vd",
    "zerorf-lite",
    "3dgs-go+vd",
    "corgs-lite+vd",
    "3dgs-go",
    "fsgs-lite+vd",
    "splatfields-lite+vd",
)
EXACT = (2.0**-20, 2.0**12)
"""Powers of two change no mantissa: every number must stay as it is, to the last bit."""
OTHER = (0.002, 1e3)
"""Other factors round the first points in float32."""
STEPS = 12


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48, test_views=2))


def scaled(scene, s: float):
    """The capture with all positions times s."""

    def of(views):
        c = views.cameras
        motion = c.world_from_camera.clone()
        motion[:, :3, 3] *= s
        return replace(views, cameras=Cameras(c.intrinsics, motion, c.width, c.height))

    return replace(scene, train=of(scene.train), test=of(scene.test))


def numbers(name: str, scene):
    """Losses of a short run that densifies, prunes and resets, and its test metrics."""
    preset = registry.find(name)
    small = {
        "initial_points": 400,
        "max_rays": 256,
        "rays": 128,
        "first_rays": 64,
        "noise_resolution": 2,
        "samples_per_step": 1 << 11,
        "density_bias": 0.0,
        "densify_from": 2,
        "densify_until": 12,
        "densify_every": 2,
        "prune_large_from": 2,
        "opacity_reset_every": 7,
        "floater_every": 5,
        "pseudo_from": 0,
        "co_prune_every": 4,
        "decoder_width": 4,
        "mlp_width": 16,
        "moran_weight": 0.01,
        # At the preset's rate Adam makes a difference of one part in ten million one of 0.001 in three steps.
        "lr_field": 4e-4,
    }
    config = replace(preset.quick, **{k: v for k, v in small.items() if hasattr(preset.quick, k)})
    if config.hull is not None:
        config = replace(config, hull=replace(config.hull, resolution=64))
    method, _, _ = build(preset, config, scene.train, device=CPU, seed=0)
    batches, losses = choose_batches(method, DataManager(scene.train, 0)), []
    for step in range(STEPS):
        output = method.train_step(batches(step), step)
        output.total.backward()
        method.optimise(step, output)
        losses.append(float(output.total.detach()))
    found = evaluate(method, scene.test, reference_hull=carve_reference(scene.train), device=CPU)
    return losses, found["test"]


@pytest.mark.parametrize("name", VARIANTS)
def test_powers_of_two_change_no_bit(scene, name):
    wanted = numbers(name, scene)
    assert 5 < wanted[1]["psnr"] < 30
    for s in EXACT:
        assert repr(numbers(name, scaled(scene, s))) == repr(wanted), s


@pytest.mark.parametrize("name", VARIANTS)
def test_other_units_change_no_more_than_rounding(scene, name):
    losses, metrics = numbers(name, scene)
    for s in OTHER:
        other, there = numbers(name, scaled(scene, s))
        assert other == pytest.approx(losses, rel=0.05), s
        assert there["psnr"] == pytest.approx(metrics["psnr"], abs=0.3), s


def test_a_training_view_in_which_nothing_can_be_drawn_is_refused(scene):
    c = scene.train.cameras
    motion = c.world_from_camera.clone()
    motion[2, :3, :3] = motion[2, :3, :3] @ torch.diag(motion.new_tensor([-1.0, 1.0, -1.0]))
    away = replace(scene.train, cameras=Cameras(c.intrinsics, motion, c.width, c.height))
    preset = registry.find("3dgs-go")
    config = replace(preset.quick, hull=None, initial_points=100)
    away = replace(away, points=(torch.rand(50, 3).double() * 0.1, torch.rand(50, 3)))
    with pytest.raises(SceneError, match=f"nothing is drawn in training view {scene.train.names[2]}"):
        build(preset, config, away, device=CPU, seed=0)
