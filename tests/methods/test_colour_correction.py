"""Colour correction: each view's exposure is found, novel views keep the average one, and off is off."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.methods.fields import test_nerf_methods as fields
from tests.methods.short_runs import advance, copy_of, same, set_up
from tests.methods.splats import test_corgs, test_gs_go
from visdom_plugin.methods.colour_correction import ColourCorrection
from visdom_plugin.methods.fields.ingp import Ingp
from visdom_plugin.methods.splats.corgs_lite import CorgsLite
from visdom_plugin.methods.splats.gs_go import GsGo

SMALL = {
    GsGo: replace(test_gs_go.SMALL, opacity_reset_every=0),
    CorgsLite: test_corgs.SMALL,
    **fields.SMALL,
}
GAINS = torch.tensor([[0.75, 0.8, 0.9], [1.2, 1.1, 1.0], [0.9, 1.0, 1.1], [1.15, 1.1, 1.0]])
"""Of red, green and blue in the four views; their mean is 1."""
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def tinted():
    """The scene as cameras of changing exposure and white balance would have taken it."""
    scene = make_scene(SyntheticConfig(size=48))
    assert torch.allclose(GAINS.mean(0), torch.ones(3))
    images = [
        (image.float() * gain).round().clamp(0, 255).byte()
        for image, gain in zip(scene.train.images, GAINS, strict=True)
    ]
    return replace(scene, train=replace(scene.train, images=images))


def start(method_class, scene, **changes):
    config = replace(SMALL[method_class], **changes)
    return set_up(method_class, config, scene, config.hull.carve(*scene.train.silhouettes()))


def test_maps_differ_from_the_identity_alone_and_leave_the_background():
    correction = ColourCorrection(3, 10, CPU)
    rgb, alpha = torch.rand(5, 3), torch.rand(5)
    background = torch.rand(5, 3)
    assert torch.allclose(correction.apply(rgb, alpha, background, 1), rgb, atol=1e-6)
    with torch.no_grad():
        correction.offsets += torch.rand(3, 3, 4)
    assert torch.allclose(correction.maps.mean(0), torch.eye(3, 4), atol=1e-6)
    # Where nothing is, the background is seen as it is; where something is, its own colour is mapped.
    clear = correction.apply(background, torch.zeros(5), background, 2)
    assert torch.allclose(clear, background)
    views = torch.tensor([0, 1, 2, 1, 0])
    solid = correction.apply(rgb, torch.ones(5), background, views)
    for i, view in enumerate(views):
        wanted = correction.maps[view] @ torch.cat([rgb[i], torch.ones(1)])
        assert torch.allclose(solid[i], wanted, atol=1e-6)


def test_gains_are_found():
    correction = ColourCorrection(4, 400, CPU)
    draw = torch.Generator().manual_seed(0)
    for step in range(400):
        colours, view = torch.rand(64, 3, generator=draw), step % 4
        seen = correction.apply(colours, torch.ones(64), torch.ones(3), view)
        (seen - colours * GAINS[view]).abs().mean().backward()
        correction.step(step)
    wanted = torch.cat([torch.diag_embed(GAINS), torch.zeros(4, 3, 1)], -1)
    assert (correction.maps.detach() - wanted).abs().max() < 0.03


@pytest.mark.parametrize(("method_class", "steps"), [(GsGo, 60), (Ingp, 160)])
def test_two_exposures_of_one_view_are_told_apart(tinted, method_class, steps):
    # What no scene can show: the same camera twice, darker and brighter.
    views, (dark, bright) = tinted.train.take([0, 0, 2, 2]), (0.75, 1.25)
    images = [
        (image.float() * (bright if i % 2 else dark)).clamp(0, 255).byte()
        for i, image in enumerate(views.images)
    ]
    twice = replace(tinted, train=replace(views, images=images, names=["a", "b", "c", "d"]))
    method = start(method_class, twice, colour_correction=True)
    advance(method, twice, range(steps))
    gains = method.correction.maps.detach()[:, :, :3].sum(-1).mean(-1)
    assert gains[0] < gains[1] - 0.1 and gains[2] < gains[3] - 0.1


@pytest.mark.parametrize("method_class", list(SMALL), ids=lambda c: c.__name__)
def test_a_resumed_run_equals_the_uninterrupted_one(tinted, method_class):
    straight = start(method_class, tinted, colour_correction=True)
    advance(straight, tinted, range(6))
    saved = copy_of(straight)
    advance(straight, tinted, range(6, 12))
    resumed = start(method_class, tinted, colour_correction=True)
    resumed.load_state_dict(saved)
    advance(resumed, tinted, range(6, 12))
    assert same(straight.state_dict(), resumed.state_dict())
    assert straight.state_dict()["colour_correction.offsets"].any()
    off = start(method_class, tinted)
    assert not any("colour" in name and "offsets" in name for name in off.state_dict())
