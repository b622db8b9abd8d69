"""Rays of single pixels against those of whole views."""

import pytest
import torch

from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.geometry.pixel_rays import _rays_torch, rays_of_pixels
from visdom_plugin.geometry.rotations import matrix_from_quaternion

SIZES = ((7, 5), (4, 9), (1, 1))


def _cameras(dtype) -> Cameras:
    draw = torch.Generator().manual_seed(0)
    motions = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    quaternions = torch.nn.functional.normalize(
        torch.randn(3, 4, generator=draw, dtype=torch.float64), dim=-1
    )
    motions[:, :3, :3] = matrix_from_quaternion(quaternions)
    motions[:, :3, 3] = 3 * torch.randn(3, 3, generator=draw, dtype=torch.float64)
    K = torch.tensor([[6.0, 0, 3.4], [0, 5, 2.2], [0, 0, 1]], dtype=torch.float64)
    width, height = (torch.tensor(x) for x in zip(*SIZES, strict=True))
    cameras = Cameras.from_matrices(K.expand(3, 3, 3), motions, width=width, height=height)
    return cameras.to(dtype=dtype)


@pytest.mark.parametrize("find", [rays_of_pixels, _rays_torch])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_have_the_rays_of_their_views(find, dtype):
    cameras = _cameras(dtype)
    for i, (width, height) in enumerate(SIZES):
        pixel = torch.arange(width * height)
        found = find(cameras, torch.full_like(pixel, i), pixel)
        expected = rays_of(cameras[i].to(dtype=torch.float64))
        for one, whole in zip(found, expected, strict=True):
            assert one.dtype == torch.float32
            torch.testing.assert_close(one.double(), whole.reshape(-1, 3), rtol=0, atol=2e-6)


def test_a_ray_is_the_same_whatever_is_asked_for_beside_it_and_on_any_number_of_threads():
    cameras = _cameras(torch.float64)
    view, pixel = torch.randint(2, (9000,)), torch.randint(35, (9000,))
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(rays_of_pixels(cameras, view, pixel))
    finally:
        torch.set_num_threads(before)
    assert all(map(torch.equal, *found))
    some = torch.tensor([5, 17, 8000])
    alone = rays_of_pixels(cameras, view[some], pixel[some])
    assert all(torch.equal(a[some], b) for a, b in zip(found[0], alone, strict=True))
    assert rays_of_pixels(cameras, view[:0], pixel[:0]).directions.shape == (0, 3)
