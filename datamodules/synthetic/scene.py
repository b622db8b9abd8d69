"""The built-in scene: a watering can on a table, drawn on the fly, with exact masks and an exact mesh.

It is hard where the visible domain matters: off-centre, not of unit size, thin (the bail), hollow, with holes
behind the handle and under the bail, and taken by cameras of different distance, aim, field of view and
principal point, some of which cut a piece off, so that the hull depends on K.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from datamodules.built_in import DEFAULT
from datamodules.hashing import hash_parts
from datamodules.synthetic.catalogue import BuiltIn, find_object
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.noise import disturb_masks, disturb_poses
from datamodules.synthetic.paint import paint_room
from datamodules.synthetic.render import rasterise
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.scene import Scene, Views

_CENTRE = (1.7, -0.9, 0.6)
_SCALE = 1.3
_YAW = 0.6
_SAMPLES = 3
# Training cameras: azimuth and elevation (degrees), distance (in shapes' units), field of view (degrees), aim
# off the object's middle (right, up; in half images) and principal point off the image's centre (in images).
# Any first few are well spread.
_TRAIN = (
    (20, 16, 3.3, 29, 0.02, -0.16, 0.03, -0.02),
    (200, 38, 4.4, 27, -0.12, 0.00, -0.02, 0.02),
    (112, 24, 2.9, 41, 0.26, 0.00, 0.00, 0.03),
    (285, 47, 3.9, 27, 0.34, 0.05, 0.04, 0.00),
    (65, 55, 4.8, 24, -0.05, 0.04, -0.03, -0.03),
    (245, 12, 3.0, 40, 0.02, 0.10, 0.02, 0.02),
    (155, 9, 4.1, 29, -0.25, 0.02, -0.01, 0.00),
    (330, 30, 3.5, 36, -0.08, -0.05, 0.02, -0.04),
    (10, 66, 4.3, 30, 0.05, 0.00, 0.00, 0.02),
    (180, 14, 3.2, 38, 0.00, 0.08, 0.03, 0.00),
    (90, 6, 3.7, 34, -0.10, 0.04, -0.04, 0.02),
    (270, 28, 4.6, 27, 0.06, -0.04, 0.00, -0.02),
    (45, 34, 3.1, 41, 0.03, 0.02, 0.02, 0.03),
    (225, 58, 3.6, 34, 0.00, 0.00, -0.02, 0.00),
    (135, 42, 4.9, 25, -0.04, 0.03, 0.01, -0.01),
    (312, 18, 3.4, 37, 0.08, 0.06, 0.00, 0.04),
)


def make_scene(config: SyntheticConfig | None = None, name: str = DEFAULT) -> Scene:
    """Draws a built-in scene; the same pictures, bit for bit, for the same config.

    Args:
        name: one of `datamodules.built_in.NAMES`.

    Returns:
        Scene with `mesh` set: the exact surface in the world frame. Masks are the exact silhouettes at pixel
        centres before noise.

    Raises:
        ConfigError: a field of the config is out of range.
    """
    config = config or SyntheticConfig()
    config.check()
    subject = find_object(name)
    vertices = torch.from_numpy(to_world(subject.shape.vertices, subject.middle))
    cameras = Cameras.stack([_camera(config, row) for row in _rows(config)])
    if config.truncation:
        cameras = _truncate(config, cameras, vertices)
    pictures = _draw(config, cameras, subject)
    n = config.train_views

    def views(part: slice, prefix: str, poses: Cameras, masks: Sequence[Tensor]) -> Views:
        numbered = tuple(f"{prefix}_{i:03d}" for i in range(len(poses)))
        return Views(poses, tuple(p[0] for p in pictures[part]), tuple(masks), numbered)

    masks = disturb_masks([p[1] for p in pictures[:n]], config)
    train = views(slice(0, n), "train", disturb_poses(cameras[:n], config), masks)
    test = views(slice(n, None), "test", cameras[n:], [p[1] for p in pictures[n:]])
    source = {
        "root": "built-in",
        "layout": "synthetic",
        "views": n,
        "downscale": float(config.downscale),
        "config": asdict(config),
        "train": list(train.names),
        "test": list(test.names),
        "hashes": hash_parts(train),
    }
    # The first of them was there before the others, and keeps the name that its runs have.
    scene_name = "built-in" if name == DEFAULT else name
    mesh = (vertices, torch.from_numpy(subject.shape.faces))
    return Scene(scene_name, train, test, "unknown", source, mesh=mesh)


def to_world(points: ArrayLike, middle: tuple[float, float, float]) -> np.ndarray:
    """Points (..., 3) of the shape's frame in the world frame: turned, scaled and moved off the origin."""
    c, s = math.cos(_YAW), math.sin(_YAW)
    local = np.asarray(points) - np.array(middle)
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    turned = np.stack([c * x - s * y, s * x + c * y, z], -1)
    return _SCALE * turned + np.array(_CENTRE)


def _rows(config: SyntheticConfig) -> list[tuple[float, ...]]:
    # Test cameras wind round the object; the golden angle keeps any number of them evenly spread.
    golden = 180 * (3 - math.sqrt(5))
    test: list[tuple[float, ...]] = []
    for i in range(config.test_views):
        height = (i + 0.5) / config.test_views
        test.append((33 + golden * i, 8 + 52 * height, 3.9 + 0.5 * math.cos(2.4 * i), 35, 0, 0, 0, 0))
    return [*_TRAIN[: config.train_views], *test]


def _camera(config: SyntheticConfig, row: tuple[float, ...]) -> Cameras:
    azimuth, elevation, distance, view, right, up, shift_x, shift_y = row
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    direction = torch.tensor(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ],
        dtype=torch.float64,
    )
    middle = torch.tensor(_CENTRE, dtype=torch.float64)
    vertical = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    centre = middle + _SCALE * distance * direction
    straight = look_at_camera(centre, middle, vertical)
    half = _SCALE * distance * math.tan(math.radians(view) / 2)
    aim = middle + half * (right * straight[:3, 0] - up * straight[:3, 1])
    width, height = config.frame
    focal = 0.5 * min(width, height) / math.tan(math.radians(view) / 2)
    K = [[focal, 0, width * (0.5 + shift_x)], [0, focal, height * (0.5 + shift_y)], [0, 0, 1]]
    return Cameras.from_matrices(
        torch.tensor(K, dtype=torch.float64),
        look_at_camera(centre, aim, vertical),
        width=width,
        height=height,
    )


def _truncate(config: SyntheticConfig, cameras: Cameras, vertices: Tensor) -> Cameras:
    uv, _ = project(cameras, vertices)
    left, right = uv[..., 0].amin(-1), uv[..., 0].amax(-1)
    # Even views lose their right-hand side, and so on in turn; the object slides out over the frame's edge.
    shift = cameras.width + config.truncation * (right - left) - right
    other = -config.truncation * (right - left) - left
    index = torch.arange(len(cameras))
    shift = torch.where(index % 4 == 1, shift, other) * ((index % 2 == 1) & (index < config.train_views))
    K = cameras.intrinsics.clone()
    K[:, 0, 2] += shift
    return Cameras(K, cameras.world_from_camera, cameras.width, cameras.height)


def _draw(config: SyntheticConfig, cameras: Cameras, subject: BuiltIn) -> list[tuple[Tensor, Tensor]]:
    """(image, mask) of every camera."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda i: _photograph(config, cameras[i], subject), range(len(cameras))))


def _photograph(config: SyntheticConfig, camera: Cameras, subject: BuiltIn) -> tuple[Tensor, Tensor]:
    shape = subject.shape
    s, width, height = _SAMPLES, int(camera.width), int(camera.height)
    K, motion = camera.intrinsics.numpy(), camera.world_from_camera.numpy()
    away = to_world(shape.vertices, subject.middle) - motion[:3, 3]
    local = [
        away[:, 0] * motion[0, k] + away[:, 1] * motion[1, k] + away[:, 2] * motion[2, k] for k in range(3)
    ]
    uv = np.stack([K[0, 0] * local[0] / local[2] + K[0, 2], K[1, 1] * local[1] / local[2] + K[1, 2]], -1)
    seen = rasterise(uv * s, local[2], shape.faces, width * s, height * s)
    weights = seen.weights.astype(np.float32)

    def blend(values: np.ndarray) -> np.ndarray:
        corners = values.astype(np.float32)[shape.faces[seen.face]]
        return (
            corners[:, 0] * weights[:, :1] + corners[:, 1] * weights[:, 1:2] + corners[:, 2] * weights[:, 2:]
        )

    origin, directions = _rays_in_shape(camera, subject.middle)
    points = blend(shape.vertices)
    towards = points - origin.astype(np.float32)
    towards /= np.sqrt(towards[:, :1] ** 2 + towards[:, 1:2] ** 2 + towards[:, 2:] ** 2)
    colours = subject.paint(points, blend(shape.normals), shape.parts[seen.face], towards)
    samples = np.zeros((height * s * width * s, 4), np.float32)
    samples[seen.sample, :3], samples[seen.sample, 3] = colours, 1
    samples = samples.reshape(height, s, width, s, 4)
    mask = samples[:, s // 2, :, s // 2, 3] > 0
    parts = (samples[:, i, :, j] for i in range(s) for j in range(s))
    mean = functools.reduce(np.add, parts) / np.float32(s * s)
    if config.background == "room":
        behind = paint_room(origin, directions).reshape(height, width, 3)
    else:
        behind = np.full((height, width, 3), float(config.background == "white"), np.float32)
    image = mean[..., :3] + (1 - mean[..., 3:]) * behind
    image = np.clip(image * 255 + np.float32(0.5), 0, 255).astype(np.uint8)
    return torch.from_numpy(image), torch.from_numpy(mask.copy())


def _rays_in_shape(camera: Cameras, middle: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and directions (H W, 3) float32 of the pixel centres in the shape's frame."""

    K, motion = camera.intrinsics.numpy(), camera.world_from_camera.numpy()
    v, u = np.mgrid[: int(camera.height), : int(camera.width)] + 0.5
    x, y = (u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1]
    local = [motion[k, 0] * x + motion[k, 1] * y + motion[k, 2] for k in range(3)]
    c, s = math.cos(_YAW), math.sin(_YAW)
    d = np.stack([c * local[0] + s * local[1], c * local[1] - s * local[0], local[2]], -1)
    d /= np.sqrt(d[:, :1] ** 2 + d[:, 1:2] ** 2 + d[:, 2:] ** 2)
    o = (motion[:3, 3] - np.array(_CENTRE)) / _SCALE
    return np.array([c * o[0] + s * o[1], c * o[1] - s * o[0], o[2]]) + np.array(middle), d.astype(np.float32)
