"""Photographs of the built-in object on the printed board, as a phone would take them, and the truth of them."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from datamodules.files.images import turn, undo_turn
from datamodules.synthetic.paint import paint_object
from datamodules.synthetic.render import rasterise
from datamodules.synthetic.shape import watering_can
from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.compute.waiting import counting
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.prepare.board import make_board
from visdom_plugin.prepare.settings import BoardSettings
from visdom_plugin.seeding import generator

_METRES = 0.065
"""One unit of the object's shape."""
_MIDDLE = np.array([0.13, 0.0, 0.0])
_TEXTURE_PX = 24
"""Texture pixels along a square of the board."""
_PAPER_MM = 8.0
FILLING = 40.0
"""A 35 mm equivalent with which the object fills the frame, and enough of the board is left."""
_WOOD, _WALL, _PAPER = (
    np.array(c, np.float32) for c in ((0.52, 0.36, 0.24), (0.6, 0.65, 0.67), (1, 0.98, 0.95))
)
_DIAGONAL = math.hypot(36, 24)


@dataclass(frozen=True)
class DemoConfig:
    """What the phone does to the photographs."""

    views: int = 12
    size: tuple[int, int] = (1600, 1200)
    """Long and short side in pixels."""
    focal_35: float = 26.0
    """35 mm equivalent of the focal length: of a phone's main lens. More of them brings the object closer."""
    focal_error: float = 0.04
    """By how much EXIF's focal length is too large, as a share."""
    radial: tuple[float, float] = (0.08, -0.12)
    """k1 and k2 of the lens; 0 0 for a pinhole."""
    blur_px: float = 0.6
    """Standard deviation of the blur, in pixels."""
    noise: float = 3.0
    """Standard deviation of the noise, of 255."""
    covered: float = 0.0
    """Share of the board that a sheet of paper covers in each view, somewhere else each time."""
    portrait: bool = True
    """Every third photograph is taken upright, and its file says so by EXIF's orientation tag."""
    exif: bool = True
    samples: int = 2
    """Samples per pixel along each side."""
    seed: int = 0


class Truth(NamedTuple):
    """What is true of one photograph once it is turned upright."""

    name: str
    world_from_camera: np.ndarray
    """(4, 4) OpenCV axes, in the board's frame, metres."""
    focal_px: float
    size: tuple[int, int]
    """Width and height, upright."""


def write_demo(folder: Path, config: DemoConfig, board: BoardSettings | None = None) -> list[Truth]:
    """Writes the photographs as JPEG files; returns the truth."""
    board = board or BoardSettings()
    texture = _board_texture(board)
    with counting("drawing photographs", config.views) as count:
        return [count(_write_view(folder, config, board, texture, i)) for i in range(config.views)]


def _write_view(folder: Path, config: DemoConfig, board: BoardSettings, texture: np.ndarray, i: int) -> Truth:
    upright = config.portrait and i % 3 == 2
    size = config.size[::-1] if upright else config.size
    truth = Truth(
        f"IMG_{i + 1:04d}.jpg", _pose(i, config.views), config.focal_35 / _DIAGONAL * math.hypot(*size), size
    )
    picture = _photograph(truth, config, board, texture, i)
    if upright:
        picture = turn(picture, undo_turn(6))
    write_bytes(folder / truth.name, _jpeg(picture, 6 if upright else 1, config))
    return truth


def true_mask(truth: Truth, size: tuple[int, int], radial: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """(H, W) bool: the object as a camera of that size sees it in the view; a pinhole unless `radial` bends it."""
    scale = size[0] / truth.size[0]
    uv, depth = _project(truth, np.array(radial))
    found = rasterise(uv * scale, depth, watering_can().faces, *size)
    mask = np.zeros(size[0] * size[1], bool)
    mask[found.sample] = True
    return mask.reshape(size[1], size[0])


def _vertices() -> np.ndarray:
    return (watering_can().vertices - _MIDDLE) * _METRES


def _pose(i: int, count: int) -> np.ndarray:
    azimuth = 2 * math.pi * i / count + 0.3
    elevation = math.radians((22, 38, 55)[i % 3])
    distance = 0.36 + 0.04 * math.cos(2.4 * i)
    direction = [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    centre = torch.tensor(direction, dtype=torch.float64) * distance
    aim = torch.tensor([0.01 * math.cos(3.1 * i), 0.01 * math.sin(2.2 * i), 0.03], dtype=torch.float64)
    return look_at_camera(centre, aim, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()


def _project(truth: Truth, bent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (V, 2), origin at the corner, and depths (V,) of the object's vertices."""
    motion = truth.world_from_camera
    local = (_vertices() - motion[:3, 3]) @ motion[:3, :3]
    xy = local[:, :2] / local[:, 2:]
    r2 = (xy**2).sum(-1, keepdims=True)
    xy = xy * (1 + bent[0] * r2 + bent[1] * r2**2)
    return truth.focal_px * xy + np.array(truth.size) / 2, local[:, 2]


def _photograph(
    truth: Truth, config: DemoConfig, board: BoardSettings, texture: np.ndarray, i: int
) -> np.ndarray:
    import cv2

    s, (width, height) = config.samples, truth.size
    behind = _desk(truth, config, board, texture, i)
    shape = watering_can()
    uv, depth = _project(truth, np.array([*config.radial, 0, 0]))
    seen = rasterise(uv * s, depth, shape.faces, width * s, height * s)
    corners = shape.faces[seen.face]
    weights = seen.weights.astype(np.float32)[..., None]
    at, normal = (
        (values.astype(np.float32)[corners] * weights).sum(1) for values in (shape.vertices, shape.normals)
    )
    behind.reshape(-1, 3)[seen.sample] = paint_object(at, normal, shape.parts[seen.face])
    picture = cv2.resize(behind, (width, height), interpolation=cv2.INTER_AREA)
    if config.blur_px:
        picture = cv2.GaussianBlur(picture, (0, 0), config.blur_px)
    noise = torch.randn(picture.shape, generator=generator(config.seed, f"demo noise {i}")).numpy()
    return np.clip(picture * 255 + config.noise * noise + 0.5, 0, 255).astype(np.uint8)


def _desk(truth: Truth, config: DemoConfig, board: BoardSettings, texture: np.ndarray, i: int) -> np.ndarray:
    """(H s, W s, 3) float32 in [0, 1]: wooden table, paper with the board, the object's soft shadow."""
    s, (width, height) = config.samples, truth.size
    # All in float32, plane by plane: a photograph of 12 megapixels has as many rays.
    bent_x = (((np.arange(width * s) + 0.5) / s - width / 2) / truth.focal_px).astype(np.float32)[None]
    bent_y = (((np.arange(height * s) + 0.5) / s - height / 2) / truth.focal_px).astype(np.float32)[:, None]
    factor = _straighten(bent_x**2 + bent_y**2, config.radial)
    right, down = bent_x * factor, bent_y * factor
    motion = truth.world_from_camera.astype(np.float32)
    ray_x, ray_y, ray_z = (motion[k, 0] * right + motion[k, 1] * down + motion[k, 2] for k in range(3))
    t = motion[2, 3] / np.maximum(-ray_z, 1e-6)
    x, y = motion[0, 3] + t * ray_x, motion[1, 3] + t * ray_y
    size = np.array(board.size_m, np.float32)
    light = np.where(np.hypot(x, y) < 1.5, 0.92 + 0.25 * (x - y), 0).clip(0.6, 1.1)
    light *= 1 - 0.45 * np.exp(-((x - 0.012) ** 2 + (y + 0.008) ** 2) / (2 * 0.032**2))
    light *= 1 + 0.12 * np.sin(260 * x + 7 * np.sin(31 * y)) * np.sin(17 * y)
    table = (np.hypot(x, y) < 1.5) & (ray_z < 0)
    colour = np.where(table[..., None], _WOOD * light[..., None], _WALL)
    on = (np.abs(x) < size[0] / 2 + _PAPER_MM / 1000) & (np.abs(y) < size[1] / 2 + _PAPER_MM / 1000) & table
    x, y, light = x[on], y[on], light[on]
    column = np.floor((x / size[0] + 0.5) * texture.shape[1]).astype(int)
    row = np.floor((0.5 - y / size[1]) * texture.shape[0]).astype(int)
    printed = (column >= 0) & (column < texture.shape[1]) & (row >= 0) & (row < texture.shape[0])
    paper = np.full(len(x), 0.93, np.float32)
    paper[printed] = texture[row[printed], column[printed]]
    sheet = paper[:, None] * _PAPER
    if config.covered:
        angle, half = 2.4 * i, math.sqrt(config.covered * size[0] * size[1]) / 2
        middle = 0.32 * size * np.array([math.cos(angle), math.sin(angle)], np.float32)
        sheet[(np.abs(x - middle[0]) < half) & (np.abs(y - middle[1]) < half)] = (0.75, 0.8, 0.55)
    colour[on] = sheet * light[:, None]
    return colour.clip(0, 1)


def _straighten(bent_squared: np.ndarray, radial: tuple[float, float]) -> np.ndarray:
    """By what a bent radius is multiplied to be straight, from the bent radius squared."""
    factor = np.ones_like(bent_squared)
    for _ in range(8 if any(radial) else 0):
        straight = bent_squared * factor**2
        factor = 1 / (1 + radial[0] * straight + radial[1] * straight**2)
    return factor


def _board_texture(board: BoardSettings) -> np.ndarray:
    columns, rows = board.squares
    picture = make_board(board).generateImage((columns * _TEXTURE_PX, rows * _TEXTURE_PX), marginSize=0)
    return np.where(picture < 128, 0.06, 0.93)


def _jpeg(picture: np.ndarray, orientation: int, config: DemoConfig) -> bytes:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = orientation
    if config.exif:
        exif[0x010F], exif[0x0110] = "visdom", "demo phone"
        inner = exif.get_ifd(0x8769)
        inner[0x920A], inner[0xA405] = 5.7, round(config.focal_35 * (1 + config.focal_error))
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "JPEG", quality=93, exif=exif)
    return data.getvalue()
