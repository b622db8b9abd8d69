"""Law of pixels: twice as many never make a worse splat."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.evaluate import evaluate
from visdom_plugin.training.run import build, choose_batches

CPU = torch.device("cpu")
STEPS, SMALL = 120, 40


@pytest.fixture(scope="module")
def scenes():
    """The same photographs at two sizes, tested on the same views."""
    small, large = (make_scene(SyntheticConfig(size=size, test_views=3)) for size in (SMALL, 2 * SMALL))
    return replace(small, test=large.test), large


def trained(scene, **settings):
    """PSNR and number of Gaussians of a short run that prunes what is too large."""
    preset = registry.find("3dgs-go+vd")
    config = replace(preset.quick, steps=STEPS, initial_points=500, densify_from=20, densify_until=100)
    config = replace(config, prune_large_from=40, opacity_reset_every=0, **settings)
    config = replace(config, hull=replace(config.hull, resolution=64))
    method, _, _ = build(preset, config, scene.train, device=CPU, seed=0)
    batches = choose_batches(method, DataManager(scene.train, 0))
    for step in range(STEPS):
        output = method.train_step(batches(step), step)
        output.total.backward()
        method.optimise(step, output)
    found = evaluate(method, scene.test, reference_hull=None, device=CPU)
    return found["test"]["psnr"], method.summary()["gaussians"]


def test_twice_the_pixels_make_no_worse_picture(scenes):
    (coarse, few), (fine, many) = (trained(scene, prune_radius=0.1) for scene in scenes)
    # So short a run is not sure of its tenths.
    assert fine > coarse - 0.3 and many > 0.9 * few
    # Were the largest radius a number of pixels, three of ten Gaussians would be gone.
    assert trained(scenes[1], prune_radius_px=0.1 * SMALL)[1] < 0.8 * few
