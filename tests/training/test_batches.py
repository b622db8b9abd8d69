"""Batches depend on seed and step alone, visit every view alike and point where the pixels are."""

from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import project
from visdom_plugin.scene import Views
from visdom_plugin.training.batches import DataManager


@pytest.fixture(scope="module")
def views():
    """Four views of 48 x 36 of the built-in scene, the last of another size."""
    v = make_scene(SyntheticConfig(size=(48, 36), test_views=3)).train
    width = torch.tensor([48, 48, 48, 30])
    height = torch.tensor([36, 36, 36, 20])
    cameras = v.cameras.resized(width, height)
    images = (*v.images[:3], v.images[3][:20, :30].contiguous())
    masks = (*v.masks[:3], v.masks[3][:20, :30].contiguous())
    return Views(cameras, images, masks, v.names)


def _same(one, other):
    pairs = zip(vars(one).values(), vars(other).values(), strict=True)
    return all(b is None if a is None else torch.equal(a, b) for a, b in pairs)


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


def test_ignored_pixels_are_never_drawn_and_weigh_nothing(views):
    masks = list(views.masks)
    ignore = [None, masks[1] | (torch.arange(48) < 20), None, torch.zeros_like(masks[3])]
    part = replace(views, ignore=tuple(ignore))
    manager = DataManager(part, 1)
    for index in range(4):
        batch, plain = manager.view(index), DataManager(views, 1).view(index)
        assert torch.equal(batch.image, plain.image) and torch.equal(batch.mask, plain.mask)
        assert batch.mask_known
        if index == 1:
            assert torch.equal(batch.weight, (~ignore[1]).float())
        else:
            assert batch.weight is None
    n = 20000
    batch = manager.pixel_batch(3, n)
    view = torch.cdist(batch.origins, views.cameras.centres.float()).argmin(1)
    mine = view == 1
    uv, _ = project(views.cameras[1], (batch.origins + 2 * batch.directions)[mine].double())
    column, row = uv.long().unbind(-1)
    assert not ignore[1][row, column].any()
    left = (~ignore[1]).sum()
    assert len(torch.unique(row * 48 + column)) > 0.98 * left
    share = float(left / (2 * 48 * 36 + 30 * 20 + left))
    assert abs(mine.float().mean() - share) < 4 * (share / n) ** 0.5
    assert batch.mask_known is None
    with pytest.raises(SceneError, match="every pixel"):
        DataManager(replace(views, ignore=tuple(m | True for m in masks)), 1).pixel_batch(0, 4)


def test_nothing_ignored_draws_what_it_always_drew(views):
    empty = replace(
        views, ignore=tuple(torch.zeros_like(m) for m in views.masks), mask_origins=("given",) * 4
    )
    one, other = DataManager(views, 2), DataManager(empty, 2)
    assert _same(one.pixel_batch(5, 99), other.pixel_batch(5, 99))
    assert other.view_batch(5).weight is None and other.view_batch(5).mask_known


def test_pixels_of_views_for_colour_only_say_so(views):
    origins = ("given", "colour", "hull", "given")
    manager = DataManager(replace(views, mask_origins=origins), 2)
    assert [manager.view(i).mask_known for i in range(4)] == [True, False, True, True]
    batch = manager.pixel_batch(0, 500)
    view = torch.cdist(batch.origins, views.cameras.centres.float()).argmin(1)
    assert torch.equal(batch.mask_known, view != 1) and (view == 1).any()
