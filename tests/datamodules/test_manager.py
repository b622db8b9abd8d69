"""Batches depend on seed and step alone, visit every view alike and point where the pixels are."""

import pytest
import torch

from datamodules.manager import DataManager
from visdom_plugin.cameras import project
from visdom_plugin.scene import Views


@pytest.fixture(scope="module")
def views(tiny):
    """Four views, the last of another size."""
    v = tiny.train
    width = torch.tensor([48, 48, 48, 30])
    height = torch.tensor([36, 36, 36, 20])
    cameras = v.cameras.resized(width, height)
    images = (*v.images[:3], v.images[3][:20, :30].contiguous())
    masks = (*v.masks[:3], v.masks[3][:20, :30].contiguous())
    return Views(cameras, images, masks, v.names)


def _same(one, other):
    return all(b is None if a is None else torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_batches_are_pure_functions_of_seed_and_step(views):
    one, other = DataManager(views, 5), DataManager(views, 5)
    order = [one.view_index(step) for step in range(24)]
    assert [other.view_index(step) for step in reversed(range(24))] == order[::-1]
    late = other.pixel_batch(17, 50)
    for step in range(17):
        one.pixel_batch(step, 50)
    assert _same(one.pixel_batch(17, 50), late)
    assert not torch.equal(one.pixel_batch(18, 50).rgb, late.rgb)
    assert not torch.equal(DataManager(views, 6).pixel_batch(17, 50).rgb, late.rgb)


def test_every_pass_is_a_permutation_of_its_own(views):
    passes = [tuple(DataManager(views, 0).view_index(4 * p + i) for i in range(4)) for p in range(12)]
    assert all(sorted(order) == [0, 1, 2, 3] for order in passes)
    assert len(set(passes)) > 4


def test_whole_views(views):
    manager = DataManager(views, 0)
    for step in range(4):
        batch = manager.view_batch(step)
        assert batch.image.shape == (int(batch.camera.height), int(batch.camera.width), 3)
        assert torch.equal((batch.image * 255).round().to(torch.uint8), views.images[batch.index])
        assert torch.equal(batch.mask > 0.5, views.masks[batch.index])
        assert batch.mono_depth is None


def test_pixels_lie_on_their_rays_and_are_drawn_evenly(views):
    manager = DataManager(views, 1)
    n = 40000
    batch = manager.pixel_batch(0, n)
    assert torch.allclose(batch.directions.norm(dim=-1), torch.ones(n), atol=1e-6)
    centres = views.cameras.centres.float()
    view = torch.cdist(batch.origins, centres).argmin(1)
    for i in range(4):
        mine = view == i
        h, w = views.masks[i].shape
        share = h * w / (3 * 48 * 36 + 30 * 20)
        assert abs(mine.float().mean() - share) < 4 * (share / n) ** 0.5
        points = (batch.origins + 2 * batch.directions)[mine].double()
        uv, depth = project(views.cameras[i], points)
        assert (depth > 0).all()
        assert (uv - uv.floor() - 0.5).abs().max() < 1e-3
        column, row = uv.long().unbind(-1)
        assert torch.equal((batch.rgb[mine] * 255).round().to(torch.uint8), views.images[i][row, column])
        assert torch.equal(batch.mask[mine] > 0.5, views.masks[i][row, column])
        assert len(torch.unique(row * w + column)) > 0.99 * h * w
