"""What may carve, and what the summary says of it."""

import pytest
import torch

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Scene, Views, describe_masks


def make_views(**fields):
    n = 4
    cameras = Cameras.from_matrices(
        torch.tensor([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]).repeat(n, 1, 1),
        torch.eye(4).repeat(n, 1, 1),
        width=8,
        height=6,
    )
    draw = torch.Generator().manual_seed(0)
    masks = tuple(torch.rand(6, 8, generator=draw) > 0.5 for _ in range(n))
    images = tuple(torch.zeros(6, 8, 3, dtype=torch.uint8) for _ in range(n))
    return Views(cameras, images, masks, tuple("abcd"), **fields)


def test_given_masks_carve_as_they_are():
    views = make_views()
    cameras, masks, _ = views.silhouettes()
    assert cameras is views.cameras and masks is views.masks
    assert [views.mask_origin(i) for i in range(4)] == ["given"] * 4
    assert views.ignored(2) is None


@pytest.mark.parametrize("origin", ["missing", "hull", "colour"])
def test_only_given_masks_carve(origin):
    views = make_views(mask_origins=("given", origin, "given", origin))
    cameras, masks, _ = views.silhouettes()
    assert torch.equal(cameras.world_from_camera, views.cameras.world_from_camera[[0, 2]])
    assert len(masks) == 2 and torch.equal(masks[1], views.masks[2])


def test_an_unknown_pixel_may_be_object():
    ignore = torch.zeros(6, 8, dtype=torch.bool)
    ignore[2:4] = True
    views = make_views(ignore=(None, ignore, None, None))
    _, masks, _ = views.silhouettes()
    assert masks[1][2:4].all() and torch.equal(masks[1][4:], views.masks[1][4:])
    assert masks[0] is views.masks[0]


def test_the_summary_tells_the_kinds_apart_and_reads_no_pixels_of_plain_views():
    class Untouchable(tuple):
        def __getitem__(self, index):
            raise AssertionError("pixels were read")

    views = make_views()
    lines = describe_masks(
        Views(views.cameras, Untouchable(views.images), Untouchable(views.masks), views.names)
    )
    assert len(lines) == 1 and lines[0].startswith("4 foreground masks")
    half = torch.ones(6, 8, dtype=torch.bool).tril(0)
    mixed = make_views(ignore=(None, half, None, None), mask_origins=("given", "given", "hull", "colour"))
    text = "\n".join(describe_masks(mixed))
    assert "2 foreground" in text and "1 view with the outline of" in text and "for colour inside" in text
    assert f"1 view with ignored pixels ({half.float().mean():.1%}" in text


def test_a_scene_is_shown_in_one_line():
    views = make_views()
    scene = Scene("kettle", views, views.take([1]))
    assert repr(views) == "Views(4 of 8 x 6 pixels: a, b, c, d)"
    assert repr(scene) == f"Scene('kettle', train={views!r}, test=Views(1 of 8 x 6 pixels: b))"
