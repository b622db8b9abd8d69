"""Photographs that contradict a shape carve it, as far as silhouettes allow."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, ring
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.carving.votes import Grid, gather_silhouettes
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.hull.inside.photo_consistency import PhotoConsistency
from visdom_plugin.hull.inside.shape import shape_inside

BALLS = [((0.0, 0.0, 0.0), 0.8), ((0.7, 0.3, 0.5), 0.4)]
ON = InsideConfig(photo_weight=0.2, photo_tolerance=0.2)


def capture(views=5):
    cameras = ring(views)
    masks = ball_masks(cameras, BALLS)
    return cameras, masks, VisibleDomain(resolution=64).carve(cameras, masks)


def painted(masks, colours):
    """Photographs of one colour each, uint8."""
    return [
        torch.as_tensor(255 * np.asarray(m)[..., None] * np.array(c)).round().byte()
        for m, c in zip(masks, colours, strict=True)
    ]


GREY, CHECKED = [(0.4, 0.4, 0.4)] * 5, [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)] * 2 + [(0.5, 0.5, 0.5)]


def test_photographs_that_agree_change_nothing():
    cameras, masks, hull = capture()
    alone = shape_inside(hull, cameras, masks)
    assert shape_inside(hull, cameras, masks, (), ON, painted(masks, GREY)) == alone
    assert shape_inside(hull, cameras, masks, (), InsideConfig(), painted(masks, CHECKED)) == alone


def test_photographs_that_disagree_carve_and_every_mask_stays_covered():
    cameras, masks, hull = capture()
    sizes = []
    for weight in (0.0, 0.1, 0.3):
        config = InsideConfig(photo_weight=weight, photo_tolerance=0.2)
        inner = shape_inside(hull, cameras, masks, (), config, painted(masks, CHECKED))
        sizes.append(inner.voxels)
        assert not (inner.occupancy & ~hull.occupancy).any()
        before, after = (measure_coverage(shape, cameras, masks) for shape in (hull, inner))
        assert all(b.covered > a.covered - 0.005 for a, b in zip(before, after, strict=True))
    assert all(a > 1.02 * b for a, b in pairwise(sizes)), sizes


def look(cameras, masks, images, ignore=()):
    """What speaks against each voxel of a ball, and the ball, 40 voxels a side."""
    level = Grid(np.full(3, -1.0), 0.05, (40, 40, 40))
    x = -1 + 0.05 * (np.arange(40) + 0.5)
    distance = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)
    u = (distance < 0.8).astype(np.float32)
    blurred = (0.5 + 4 * (0.8 - distance)).clip(0, 1).astype(np.float32)
    silhouettes = gather_silhouettes(cameras, masks, ignore).demanding()
    return PhotoConsistency(cameras, silhouettes, images, 0.2).contradiction(u, blurred, level), distance


def test_only_the_surface_that_two_views_see_is_spoken_against():
    cameras = ring(2)
    masks = ball_masks(cameras, BALLS[:1])
    against, distance = look(cameras, masks, painted(masks, CHECKED[:2]))
    seen = against > 0
    assert seen.any() and (np.abs(distance[seen] - 0.8) < 0.15).all()
    # Black and white: a standard deviation of 0.5.
    assert against[seen] == pytest.approx(1 - np.exp(-(0.5**2) / 0.2**2), abs=1e-5)
    # Each view sees less than half of a ball, and the other one sees part of that.
    assert np.count_nonzero(seen) < 0.5 * np.count_nonzero(np.abs(distance - 0.8) < 0.1)


def test_ignored_pixels_and_the_range_of_colours_do_not_matter():
    cameras = ring(3)
    masks = ball_masks(cameras, BALLS[:1])
    images = painted(masks, [(0.2, 0.2, 0.2), (0.2, 0.2, 0.2), (0.9, 0.9, 0.9)])
    against, _ = look(cameras, masks, images)
    floats, _ = look(cameras, masks, [x.float() / 255 for x in images])
    assert against.any() and np.array_equal(against, floats)
    ignored = [None, None, torch.ones(images[2].shape[:2], dtype=torch.bool)]
    assert look(cameras, masks, images, ignored)[0].max() < 1e-3 < against.max()


def test_threads_do_not_matter():
    cameras, masks, hull = capture()
    before, shapes = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            shapes.append(shape_inside(hull, cameras, masks, (), ON, painted(masks, CHECKED)))
    finally:
        torch.set_num_threads(before)
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize("field", [{"photo_weight": -0.1}, {"photo_weight": 0.6}, {"photo_tolerance": 0.0}])
def test_settings_that_cannot_be_right_are_refused(field):
    with pytest.raises(ConfigError, match=next(iter(field))):
        InsideConfig(**field)
