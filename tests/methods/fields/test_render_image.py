"""Pictures of fields: ray by ray in pieces, however large."""

import pytest
import torch

from visdom_plugin.compute import waiting
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.methods.fields import common
from visdom_plugin.methods.fields.common import render_image
from visdom_plugin.nerf.frame import Frame

FRAME = Frame(torch.zeros(3, dtype=torch.float64), 0.5)


def camera(width=37, height=23):
    motion = look_at_camera(torch.tensor([[3.0, 1, 2]]), torch.zeros(1, 3), torch.tensor([0.0, 0, 1]))
    intrinsics = torch.tensor([[[40.0, 0, 18], [0, 41, 12], [0, 0, 1]]])
    return Cameras.from_matrices(intrinsics, motion, width=width, height=height)[0]


def show(origins, directions):
    return (
        directions.float().abs(),
        (directions[:, 2] > -0.5).float(),
        (origins - directions).norm(dim=-1).float(),
    )


def test_pieces_of_any_size_make_the_picture_of_all_rays_at_once():
    one = camera()
    rays = rays_of(one.to(dtype=torch.float64))
    colour, opacity, distance = show(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3))
    along = (rays.directions @ one.forward.double()).float().reshape(-1)
    depth = torch.where(opacity > 0, distance * along / 0.5, 0)
    for chunk in (1, 100, 37 * 23, 10_000):
        render = render_image(one, show, FRAME, chunk)
        torch.testing.assert_close(render.rgb.reshape(-1, 3), colour)
        torch.testing.assert_close(render.alpha.flatten(), opacity)
        torch.testing.assert_close(render.depth.flatten(), depth)


def test_no_more_than_a_chunk_of_rays_exists_at_a_time():
    sizes = []

    def count(origins, directions):
        sizes.append((len(origins), directions.untyped_storage().nbytes() // directions[0].nbytes))
        return show(origins, directions)

    render_image(camera(), count, FRAME, 64)
    assert max(n for n, _ in sizes) == 64 and sum(n for n, _ in sizes) == 37 * 23
    assert max(kept for _, kept in sizes) <= 64


@pytest.mark.parametrize(("after", "shown"), [(-1.0, True), (1000.0, False)])
def test_of_a_long_view_the_screen_shows_how_far_it_is(monkeypatch, after, shown):
    begun, ended = [], []
    monkeypatch.setattr(common, "SPEAK_AFTER", after)
    monkeypatch.setattr(waiting.screen, "begin", lambda text: begun.append((text, text())))
    monkeypatch.setattr(waiting.screen, "end", ended.append)
    render_image(camera(), show, FRAME, 64)
    assert len(begun) == len(ended) == shown
    if shown:
        ((text, first),) = begun
        assert first.startswith("drawing a view of 37 x 23 pixels: 1 of 14, ")
        assert text().startswith("drawing a view of 37 x 23 pixels: 14 of 14, ") and ended == [text]
