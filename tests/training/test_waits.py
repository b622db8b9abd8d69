"""A step asks the device for nothing: what runs before and beside the rasteriser, on tensors that cannot be read.

Tensors on torch's device "meta" have shapes and no values, so that `int`, `bool`, `.item()` and `.cpu()` of one
raise. They stand for a GPU here, for which the host would wait; copies to it are counted.
"""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from datamodules.synthetic.scene import SyntheticConfig, make_scene
from method_configs import gs_go
from visdom_plugin.compute.transfer import send
from visdom_plugin.hooks.regularizer import VisDomGaussianRegularizer
from visdom_plugin.hooks.sampler import VisDomSampler
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import Crossing
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.render import Render
from visdom_plugin.training.batches import DataManager

META = torch.device("meta")


class Copies(TorchDispatchMode):
    """Counts copies from the host to the device for which the host waits."""

    def __init__(self):
        super().__init__()
        self.waits = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.ops.aten._to_copy.default and kwargs.get("device") == META:
            self.waits += args[0].device.type == "cpu" and not kwargs.get("non_blocking")
        return function(*args, **kwargs)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48, train_views=4))


@pytest.fixture(scope="module")
def hull(scene):
    return VisibleDomain(resolution=32).carve(*scene.train.silhouettes())


def draw_on_meta(gaussians, camera, background, **_):
    """A picture that depends on all it is made of; the camera's size is asked as a rasteriser asks it."""
    width, height = camera.size
    motion = camera.camera_from_world.to(gaussians.means)
    value = gaussians.means.sum() + gaussians.opacity_logits.sum() + motion.sum()
    alpha = value.sigmoid().expand(height, width)
    return Render(background * alpha[..., None], alpha, value.expand(height, width))


def test_what_would_wait_is_seen():
    with pytest.raises(RuntimeError):
        int(torch.ones((), device=META))
    with Copies() as copies:
        torch.ones(3).to(META)
        send(torch.ones(3), META)
    assert copies.waits == 1


def test_a_splat_step_waits_for_nothing(scene, hull, monkeypatch):
    monkeypatch.setattr("visdom_plugin.splat.model.rasterise", draw_on_meta)
    monkeypatch.setattr("visdom_plugin.methods.splats.splat_method.refuse_unseen", lambda *_: None)
    views = scene.train
    hook = VisDomGaussianRegularizer(hull, views.cameras.to("cpu"), bank=2)
    hook._device = META
    config = replace(gs_go.SPEC.quick, initial_points=50, hull=None, mask_weight=0.1)
    splats = GsGo(config)
    splats.setup(views, [], hull=hull, device=META, seed=0)
    splats.hooks = [hook]
    batches = DataManager(views, 0, device=META)
    for step in range(12):  # the bank is filled
        splats.train_step(batches.view_batch(step), step)
    with Copies() as copies:
        output = splats.train_step(batches.view_batch(12), 12)
        output.total.backward()
    assert "visdom_outside" in output.losses and "mask" in output.losses
    assert copies.waits == 0


def test_a_batch_of_pixels_and_its_bounds_wait_for_nothing(scene, hull):
    batches, hook = DataManager(scene.train, 0, device=META), VisDomSampler(hull, cameras=scene.train.cameras)
    hook.follow_pixels(scene.train.cameras)
    count = int(hook._pixels.ends[-1])
    hook._pixels.found = Crossing(
        *(torch.empty(count, dtype=d, device=META) for d in (torch.float, torch.float, torch.bool))
    )
    batches.pixel_batch(0, 10)
    with Copies() as copies:
        batch = batches.pixel_batch(1, 100)
        near = torch.zeros(100, device=META)
        bounds = hook.bound_pixels(batch.pixels, batch.origins, batch.directions, near, near + 9)
    assert bounds.near.shape == (100,) and copies.waits == 0


def test_points_are_looked_up_without_waiting(hull):
    points = torch.empty(20, 3, device=META)
    hull.contains(points)
    with Copies() as copies:
        assert hull.contains(points).shape == (20,)
    assert copies.waits == 0
