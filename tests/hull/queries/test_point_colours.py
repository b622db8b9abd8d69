import numpy as np
import torch

from tests.hull.balls import ring
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.point_colours import colour_points

RED, BLUE = torch.tensor([255, 0, 0], dtype=torch.uint8), torch.tensor([0, 0, 255], dtype=torch.uint8)


def two_sides() -> tuple[Hull, Cameras, list]:
    """A cube seen from +x by a red view and from -x by a blue one."""
    hull = Hull.from_grid(np.ones((16, 16, 16)), [[-1] * 3, [1] * 3])
    centres = torch.tensor([[5.0, 0, 0], [-5.0, 0, 0]]).double()
    motion = look_at_camera(centres, torch.zeros(2, 3).double(), torch.tensor([0.0, 0, 1]).double())
    intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]).double().expand(2, 3, 3)
    cameras = Cameras.from_matrices(intrinsics, motion, width=64, height=64)
    return hull, cameras, [RED.expand(64, 64, 3), BLUE.expand(64, 64, 3)]


def test_each_side_takes_the_view_that_sees_it():
    hull, cameras, images = two_sides()
    points = torch.tensor([[1.0, 0.2, 0.1], [-1.0, 0.2, 0.1], [0.0, 0.0, 0.0], [50.0, 60.0, 0.0]])
    colour = colour_points(hull, points, cameras, images)
    # Seen from one side; hidden from both: the mean; outside both frames: grey.
    wanted = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0.5, 0, 0.5], [0.5, 0.5, 0.5]])
    assert colour.dtype == torch.float32 and torch.allclose(colour, wanted)


def test_float_images_give_the_same_colours():
    hull, cameras, images = two_sides()
    points = hull.sample_points(500, torch.Generator().manual_seed(0))
    floats = [image.float() / 255 for image in images]
    assert torch.equal(
        colour_points(hull, points, cameras, images), colour_points(hull, points, cameras, floats)
    )


def test_colours_come_from_the_pixel_of_the_projection():
    from visdom_plugin.geometry.cameras import project

    cameras = ring(1, size=50)
    hull = Hull.from_grid(np.ones((8, 8, 8)), [[-0.5] * 3, [0.5] * 3])
    image = torch.randint(0, 256, (50, 50, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    points = hull.sample_points(300, torch.Generator().manual_seed(1))
    uv, _ = project(cameras[0], points)
    wanted = torch.stack([image[int(v), int(u)] for u, v in uv]).float() / 255
    assert torch.equal(colour_points(hull, points, cameras, [image]), wanted)


def test_no_points():
    hull, cameras, images = two_sides()
    assert colour_points(hull, torch.zeros(0, 3), cameras, images).shape == (0, 3)
