"""Photographs warped over a shape into views that nobody took."""

import numpy as np
import pytest
import torch

from tests.hull.balls import ring
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.photo_warp import PhotoWarp
from visdom_plugin.hull.queries.raycast import cast

BALLS = np.array([[0.0, 0, 0, 0.6], [1.0, 0, 0, 0.25]])


@pytest.fixture(scope="module")
def shape():
    """Two balls, the small one beside the large one."""
    centres = (np.indices((120, 80, 80)).transpose(1, 2, 3, 0) + 0.5) / 40 - 1
    inside = [(np.square(centres - b[:3]).sum(-1) < b[3] ** 2) for b in BALLS]
    return Hull(np.any(inside, axis=0), np.array([[-1.0, -1, -1], [2, 1, 1]]))


def paint(points):
    """A smooth colour of every place."""
    return 0.5 + 0.3 * torch.sin(2 * points + torch.tensor([0.0, 1, 2]))


def photograph(shape, camera, colour=paint):
    """The painted shape on grey, and its mask."""
    rays = rays_of(camera.to(dtype=torch.float64))
    crossing = cast(shape, rays.origins, rays.directions)
    points = rays.origins + crossing.t_first[..., None] * rays.directions
    return torch.where(crossing.hit[..., None], colour(points), 0.5).float(), crossing.hit


def test_photographs_of_the_shape_itself_give_every_view_of_it(shape):
    cameras = ring(8)
    images, masks = zip(*(photograph(shape, cameras[i]) for i in range(0, 8, 2)), strict=True)
    warp = PhotoWarp(shape, cameras[::2], images, masks)
    for i in (1, 4):
        truth, mask = photograph(shape, cameras[i])
        drawn = warp.draw(cameras[i])
        assert torch.equal(drawn.silhouette, mask) and not drawn.trust[~mask].any()
        trusted = drawn.trust > 0.9
        assert trusted[mask].float().mean() > 0.8
        assert (drawn.rgb - truth)[trusted].abs().mean() < 0.02


def test_bytes_are_the_same_as_numbers_from_0_to_1(shape):
    camera = ring(3)
    images, masks = zip(*(photograph(shape, camera[i]) for i in range(3)), strict=True)
    images = [(255 * image).round().byte() for image in images]
    one = PhotoWarp(shape, camera, images, masks).draw(camera[0])
    other = PhotoWarp(shape, camera, [image.float() / 255 for image in images], masks).draw(camera[0])
    assert torch.equal(one.rgb, other.rgb) and torch.equal(one.trust, other.trust)


def test_photographs_that_contradict_each_other_are_not_trusted(shape):
    cameras = ring(8)
    pair = cameras[[0, 2]]
    (red, mask), (blue, other) = (
        photograph(shape, pair[i], lambda p, i=i: torch.eye(3)[i].double().expand(p.shape)) for i in range(2)
    )
    warp = PhotoWarp(shape, pair, [red, blue], [mask, other])
    seen_by_both = warp.draw(cameras[1])
    middle = seen_by_both.silhouette & (seen_by_both.rgb.amax(-1) < 0.7)
    assert middle.any() and seen_by_both.trust[middle].max() < 0.01


def test_what_no_photograph_shows_is_not_trusted(shape):
    cameras = ring(8)
    image, mask = photograph(shape, cameras[0])
    warp = PhotoWarp(shape, cameras[:1], [image], [mask])
    assert warp.draw(cameras[4]).trust.max() == 0
    nothing = PhotoWarp(shape, cameras[:1], [image], [torch.zeros_like(mask)])
    assert nothing.draw(cameras[0]).trust.max() == 0


def test_a_part_that_is_hidden_does_not_take_the_colour_of_what_hides_it(shape):
    """A camera that sees the large ball only in front of the small one says nothing of the small one."""
    cameras = ring(16)
    offsets = torch.nn.functional.normalize(cameras.centres, dim=-1)
    hiding = int((offsets @ torch.tensor([-1.0, 0, 0]).to(offsets)).argmax())
    image, mask = photograph(shape, cameras[hiding])
    drawn = PhotoWarp(shape, cameras[[hiding]], [image], [mask]).draw(cameras[(hiding + 3) % 16])
    points = rays_of(cameras[(hiding + 3) % 16].to(dtype=torch.float64))
    crossing = cast(shape, points.origins, points.directions)
    x = (points.origins + crossing.t_first[..., None] * points.directions)[..., 0]
    on_small = crossing.hit & (x > 0.9)
    assert on_small.any() and drawn.trust[on_small].max() == 0
