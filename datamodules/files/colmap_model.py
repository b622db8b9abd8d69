"""COLMAP's sparse models, text and binary: cameras and registered images.

Formats after COLMAP's documentation (doc/format.rst): little-endian, poses world to camera as Hamilton
quaternions (w, x, y, z) and translations, pixel centres at +0.5. Declared counts are compared with the bytes
that are there before anything is allocated, so a damaged file costs no more memory than its own size.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import torch

from datamodules.files.parsers import blame_commas, damaged, decode_text
from datamodules.files.paths import inside, read_inside
from datamodules.files.pinholes import pinholes
from datamodules.files.undistort import COEFFICIENTS, Distortion, advise_undistorting
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion

# Name and number of parameters by model id; the ids from 11 on came with COLMAP 3.12 and later.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
    16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
"""Of the models that can be undistorted, those whose parameters begin f, cx, cy and not fx, fy, cx, cy."""
_T = TypeVar("_T")


@dataclass(frozen=True)
class Intrinsics:
    """One entry of the cameras file."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Registered:
    """One entry of the images file."""

    name: str
    """Path relative to the image folder, with forward slashes."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) world to camera, any length but zero."""
    translation: tuple[float, float, float]
    """World to camera."""
    camera_id: int


@dataclass(frozen=True)
class Model:
    """A sparse model: its cameras by id and its registered images in the order of the file."""

    folder: Path
    cameras: dict[int, Intrinsics]
    images: tuple[Registered, ...]
    files: tuple[str, ...] = ()
    """What it was read from, below the scene's folder."""


def read_model(root: Path, folder: str, *, outside: bool = False) -> Model:
    """Reads `cameras` and `images` of a model folder, the binary pair where there is one, else the text pair.

    Args:
        root: the scene's folder.
        folder: of the model, below it; "" for the root itself.
        outside: files may lie outside of the root.

    Raises:
        SceneError: no complete pair, or a file that is truncated, damaged or contradicts itself.
    """
    for suffix, read_cameras, read_images in (
        (".bin", parse_cameras_binary, parse_images_binary),
        (".txt", parse_cameras_text, parse_images_text),
    ):
        names = [f"{folder}/{name}{suffix}".lstrip("/") for name in ("cameras", "images")]
        paths = [inside(root, name, outside=outside) for name in names]
        if all(path.is_file() for path in paths):
            cameras, images = (read_inside(root, name, outside=outside) for name in names)
            registered = tuple(read_images(images, paths[1]))
            return Model(root / folder, read_cameras(cameras, paths[0]), registered, tuple(names))
    raise SceneError(
        "no COLMAP model: neither cameras.bin with images.bin nor cameras.txt with images.txt",
        where=root / folder,
        todo="put the model's files there; colmap model_converter turns one form into the other",
        topic="no-scene",
    )


def cameras_of(model: Model, images: Sequence[Registered]) -> tuple[Cameras, list[Distortion | None]]:
    """Float64 cameras of some registered images, at the full resolution of the model, and their distortions.

    Raises:
        SceneError: for a lens model that cannot be undistorted, impossible sizes or intrinsics, NaN or
            infinite poses, a zero quaternion, or a camera id that the model does not have; named by image.
    """
    K, rotations, translations, distortions = [], [], [], []
    for image in images:
        lens = model.cameras.get(image.camera_id)
        if lens is None:
            raise SceneError(
                f"image {image.name} refers to camera {image.camera_id}, which the model does not have",
                where=model.folder,
                cause="the cameras and images files come from different models, or one is damaged",
                todo="export both from the same reconstruction",
                topic="poses",
            )
        matrix, distortion = _lens(lens, image.name, model)
        K.append(matrix)
        distortions.append(distortion)
        if max(map(abs, image.quaternion)) < 1e-150:
            raise SceneError(
                f"the quaternion of image {image.name} is zero, which is no rotation",
                where=model.folder,
                cause="a pose that was never filled in",
                todo="drop the view from the model and the index files, or estimate its pose again",
                topic="poses",
            )
        rotations.append(image.quaternion)
        translations.append(image.translation)
    quaternion = torch.tensor(rotations, dtype=torch.float64).reshape(-1, 4)
    # Scaling first keeps very long and very short quaternions from overflowing when they are normalised.
    quaternion = quaternion / quaternion.abs().amax(-1, keepdim=True)
    rotation = matrix_from_quaternion(quaternion).mT
    centre = -(rotation @ torch.tensor(translations, dtype=torch.float64).reshape(-1, 3, 1))
    lenses = [model.cameras[image.camera_id] for image in images]
    cameras = pinholes(
        K,
        torch.cat([rotation, centre], -1).numpy(),
        [(lens.width, lens.height) for lens in lenses],
        names=[image.name for image in images],
        where=model.folder,
    )
    return cameras, distortions


def _lens(lens: Intrinsics, name: str, model: Model) -> tuple[tuple[float, ...], Distortion | None]:
    if lens.model not in COEFFICIENTS:
        known = lens.model in dict(MODELS.values())
        raise SceneError(
            f"image {name} has the {'' if known else 'unknown '}lens model {lens.model[:40]}; possible are "
            + ", ".join(COEFFICIENTS),
            where=model.folder,
            cause="the photographs still have their lens distortion" if known else None,
            todo=advise_undistorting(*(str(PurePosixPath(file).parent) for file in model.files[:1])),
            topic="lens",
        )
    if lens.model in _ONE_FOCAL:
        fx, cx, cy, *rest = lens.params
        fy = fx
    else:
        fx, fy, cx, cy, *rest = lens.params
    distortion = Distortion(lens.model, tuple(rest))
    return (fx, fy, cx, cy), None if distortion.absent else distortion


class ByteReader:
    """A reader that never goes past the end of its file."""

    def __init__(self, data: bytes, path: Path):
        self.path, self.data, self.at = path, data, 0

    def take(self, form: str) -> tuple:
        self.need(struct.calcsize(form))
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def need(self, size: int) -> None:
        left = len(self.data) - self.at
        if size > left:
            damaged(self.path, f"{self.path.name} ends too early: {size} more bytes declared, {left} left")

    def count(self, smallest: int) -> int:
        (number,) = self.take("<Q")
        self.need(number * smallest)
        return number

    def skip(self, size: int) -> None:
        self.need(size)
        self.at += size

    def string(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            damaged(self.path, f"{self.path.name} ends inside an image name")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            damaged(self.path, f"{self.path.name} holds an image name that is not UTF-8: {raw[:40]!r}")

    def finish(self) -> None:
        if self.at != len(self.data):
            damaged(self.path, f"{self.path.name} goes on for {len(self.data) - self.at} bytes after its end")


def parse_cameras_binary(data: bytes, path: Path) -> dict[int, Intrinsics]:
    """Of cameras.bin, by id."""
    file = ByteReader(data, path)
    cameras: dict[int, Intrinsics] = {}
    for _ in range(file.count(24 + 16)):
        camera_id, model_id, width, height = file.take("<IiQQ")
        if model_id not in MODELS:
            damaged(
                path,
                f"camera {camera_id} has the unknown model id {model_id}",
                cause="a damaged file, or one written by a newer COLMAP",
            )
        name, parameters = MODELS[model_id]
        _add(cameras, camera_id, Intrinsics(name, width, height, file.take(f"<{parameters}d")), path)
    file.finish()
    return cameras


def parse_images_binary(data: bytes, path: Path) -> list[Registered]:
    """Of images.bin, in its order; 2D points are passed over."""
    file = ByteReader(data, path)
    images: dict[int, Registered] = {}
    for _ in range(file.count(4 + 56 + 4 + 1 + 8)):
        image_id, qw, qx, qy, qz, tx, ty, tz, camera_id = file.take("<I7dI")
        name = file.string()
        file.skip(file.count(24) * 24)
        _add(images, image_id, Registered(name, (qw, qx, qy, qz), (tx, ty, tz), camera_id), path)
    file.finish()
    return list(images.values())


def _add(table: dict[int, _T], key: int, value: _T, path: Path) -> None:
    if key in table:
        damaged(path, f"{path.name} lists the id {key} twice", cause="a damaged or badly merged file")
    table[key] = value


def text_lines(data: bytes, path: Path) -> list[str]:
    """The lines of a text file in UTF-8 (or UTF-16 with its mark)."""
    return decode_text(data, path, "a binary or damaged file named .txt").splitlines()


def parse_cameras_text(data: bytes, path: Path) -> dict[int, Intrinsics]:
    """Of cameras.txt, by id."""
    cameras: dict[int, Intrinsics] = {}
    known = dict(MODELS.values())
    for number, line in enumerate(text_lines(data, path), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split()
        try:
            camera_id, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            params = tuple(map(float, fields[4:]))
        except (IndexError, ValueError):
            what = f"line {number} is not `ID MODEL WIDTH HEIGHT PARAMS...`: {line.strip()[:80]!r}"
            damaged(path, what, *(blame_commas(line) or ()))
        if model in known and len(params) != known[model]:
            damaged(path, f"line {number}: {model} needs {known[model]} parameters, {len(params)} given")
        _add(cameras, camera_id, Intrinsics(model, width, height, params), path)
    return cameras


def parse_images_text(data: bytes, path: Path) -> list[Registered]:
    """Of images.txt, in its order; 2D points are passed over."""
    images: dict[int, Registered] = {}
    # Every image has two lines, and the second (its 2D points) may be empty: blank lines count.
    lines = [
        (n, line) for n, line in enumerate(text_lines(data, path), 1) if not line.lstrip().startswith("#")
    ]
    at = 0
    while at < len(lines):
        number, line = lines[at]
        at += 1
        if not line.strip():
            continue
        fields = line.strip().split(maxsplit=9)
        try:
            image_id, camera_id, name = int(fields[0]), int(fields[8]), fields[9]
            qw, qx, qy, qz, tx, ty, tz = map(float, fields[1:8])
        except (IndexError, ValueError):
            what = f"line {number} is not `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`: {line.strip()[:80]!r}"
            lost = "a damaged file, or the second line of an image (its points, often empty) was removed"
            damaged(path, what, *(blame_commas(line) or (lost,)))
        if at < len(lines):
            number, points = lines[at]
            at += 1
            if len(points.split()) % 3:
                damaged(
                    path,
                    f"line {number} is not the list of 2D points of image {name}",
                    cause="the second line of an image (its points, often empty) was removed",
                )
        _add(images, image_id, Registered(name, (qw, qx, qy, qz), (tx, ty, tz), camera_id), path)
    return list(images.values())
