"""Bounds of training pixels: found once for all of them, and the same as ray by ray."""

import pytest
import torch

from visdom_plugin import Cameras, VisDomSampler, VisibleDomain
from visdom_plugin.hooks import sampler as sampler_module
from visdom_plugin.hooks.protocols import PixelSampler
from visdom_plugin.scene import Views
from visdom_plugin.training.batches import DataManager

from .test_regularizer import SIZE, capture


@pytest.fixture(scope="module")
def views():
    """Views of three sizes."""
    cameras, _ = capture(3)
    sizes = [(SIZE, SIZE), (SIZE // 2, SIZE), (SIZE, SIZE - 7)]
    cameras = Cameras.stack([cameras[i].resized(w, h) for i, (w, h) in enumerate(sizes)])
    images = [torch.zeros(h, w, 3, dtype=torch.uint8) for w, h in sizes]
    return Views(cameras, images, [image[..., 0] == 0 for image in images], list("abc"))


@pytest.fixture(scope="module")
def hull():
    return VisibleDomain(k=3, resolution=48).carve(*capture(5))


@pytest.mark.parametrize("settings", [{}, {"interval": "first_hit", "missing": "skip"}])
def test_bounds_by_pixel_are_those_by_ray_bit_for_bit(views, hull, settings, monkeypatch):
    monkeypatch.setattr(sampler_module, "PIXELS_AT_ONCE", 1000)
    casts = []
    cast = sampler_module.cast
    monkeypatch.setattr(sampler_module, "cast", lambda *rays: casts.append(1) or cast(*rays))
    by_pixel, by_ray = (VisDomSampler(hull, **settings) for _ in range(2))
    assert isinstance(by_pixel, PixelSampler)
    by_pixel.follow_pixels(views.cameras)
    assert not casts
    batches, hits = DataManager(views, seed=0), []
    for step in range(6):
        batch = batches.pixel_batch(step, 700)
        n = len(batch.mask)
        near = torch.rand(n, generator=torch.Generator().manual_seed(step))
        rays = batch.origins, batch.directions, near, near + 5
        asked = len(casts)
        found = by_pixel.bound_pixels(batch.pixels, *rays)
        assert len(casts) - asked == (-(-sum(m.numel() for m in views.masks) // 1000) if step == 0 else 0)
        for a, b in zip(found, by_ray.bound(*rays), strict=True):
            assert torch.equal(a, b)
        hits.append(found.hit)
    assert 0.05 < torch.cat(hits).float().mean() < 0.95


def test_above_the_limit_each_question_is_answered_for_itself(views, hull, monkeypatch):
    monkeypatch.setattr(sampler_module, "MOST_PIXELS", 100)
    sampler = VisDomSampler(hull)
    sampler.follow_pixels(views.cameras)
    batch = DataManager(views, seed=0).pixel_batch(0, 50)
    rays = batch.origins, batch.directions, torch.zeros(50), torch.full((50,), 9.0)
    assert torch.equal(sampler.bound_pixels(batch.pixels, *rays).far, sampler.bound(*rays).far)
    assert sampler._pixels is None
