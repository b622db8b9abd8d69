"""COLMAP's sparse models, text and binary: cameras and registered images (3D points are not read).

Formats after COLMAP's documentation (doc/format.rst): little-endian, poses world to camera as Hamilton
quaternions (w, x, y, z) and translations, pixel centres at +0.5. Declared counts are compared with the bytes
that are there before anything is allocated, so a damaged file costs no more memory than its own size.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import torch

from datamodules.images import MAX_PIXELS
from visdom_plugin.cameras import Cameras
from visdom_plugin.errors import SceneError
from visdom_plugin.rotations import matrix_from_quaternion

# Name and number of parameters by model id; the ids from 11 on came with COLMAP 3.12 and later.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
    16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_DISTORTED = {name for name, _ in MODELS.values()} - {"SIMPLE_PINHOLE", "PINHOLE"}
_UNDISTORT = "undistort: colmap image_undistorter --image_path images --input_path sparse/0 --output_path DIR"


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


def read_model(folder: Path) -> Model:
    """Reads `cameras` and `images` of a model folder, the binary pair where there is one, else the text pair.

    Raises:
        SceneError: no complete pair, or a file that is truncated, damaged or contradicts itself.
    """
    for suffix, read_cameras, read_images in (
        (".bin", _cameras_binary, _images_binary),
        (".txt", _cameras_text, _images_text),
    ):
        cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if cameras.is_file() and images.is_file():
            try:
                return Model(folder, read_cameras(cameras), tuple(read_images(images)))
            except OSError as error:
                raise SceneError(
                    f"the COLMAP model cannot be read: {error.strerror}", where=folder
                ) from error
    raise SceneError(
        "no COLMAP model: neither cameras.bin with images.bin nor cameras.txt with images.txt",
        where=folder,
        todo="put the model's files there; colmap model_converter turns one form into the other",
    )


def cameras_of(model: Model, images: Sequence[Registered]) -> Cameras:
    """Float64 cameras of some registered images, at the full resolution of the model.

    Raises:
        SceneError: for a lens model with distortion, impossible sizes or intrinsics, NaN or infinite poses,
            a zero quaternion, or a camera id that the model does not have; named by image.
    """
    K, rotations, translations = [], [], []
    for image in images:
        lens = model.cameras.get(image.camera_id)
        if lens is None:
            raise SceneError(
                f"image {image.name} refers to camera {image.camera_id}, which the model does not have",
                where=model.folder,
                cause="the cameras and images files come from different models, or one is damaged",
                todo="export both from the same reconstruction",
            )
        K.append(_pinhole(lens, image.name, model.folder))
        _check_pose(image, model.folder)
        rotations.append(image.quaternion)
        translations.append(image.translation)
    quaternion = torch.tensor(rotations, dtype=torch.float64).reshape(-1, 4)
    # Scaling first keeps very long and very short quaternions from overflowing when they are normalised.
    quaternion = quaternion / quaternion.abs().amax(-1, keepdim=True)
    rotation = matrix_from_quaternion(quaternion).mT
    centre = -(rotation @ torch.tensor(translations, dtype=torch.float64).reshape(-1, 3, 1))
    lenses = [model.cameras[image.camera_id] for image in images]
    return Cameras.from_matrices(
        torch.tensor(K, dtype=torch.float64).reshape(-1, 3, 3),
        torch.cat([rotation, centre], -1),
        width=torch.tensor([lens.width for lens in lenses], dtype=torch.int64),
        height=torch.tensor([lens.height for lens in lenses], dtype=torch.int64),
    )


def _pinhole(lens: Intrinsics, name: str, folder: Path) -> list[list[float]]:
    if lens.model in _DISTORTED:
        raise SceneError(
            f"image {name} has the lens model {lens.model}; only PINHOLE and SIMPLE_PINHOLE can be used",
            where=folder,
            cause="the photographs still have their lens distortion",
            todo=_UNDISTORT,
        )
    if lens.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise SceneError(
            f"image {name} has the unknown lens model {lens.model}; known are PINHOLE and SIMPLE_PINHOLE",
            where=folder,
            todo=_UNDISTORT,
        )
    if lens.model == "SIMPLE_PINHOLE":
        fx, cx, cy = lens.params
        fy = fx
    else:
        fx, fy, cx, cy = lens.params
    size_ok = lens.width > 0 and lens.height > 0 and lens.width * lens.height <= MAX_PIXELS
    if not size_ok or not all(map(math.isfinite, lens.params)) or min(fx, fy) <= 0:
        raise SceneError(
            f"the camera of image {name} is impossible: {lens.width} x {lens.height} pixels, focal lengths "
            f"{fx:g} and {fy:g}, principal point ({cx:g}, {cy:g})",
            where=folder,
            cause="a damaged file, or a calibration that failed",
            todo="export the model again",
        )
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def _check_pose(image: Registered, folder: Path) -> None:
    numbers = (*image.quaternion, *image.translation)
    # Beyond 1e15 scene units float32 arithmetic on squared distances overflows.
    if not all(math.isfinite(x) for x in numbers) or max(map(abs, image.translation)) > 1e15:
        raise SceneError(
            f"the pose of image {image.name} holds NaN, infinite or absurd numbers",
            where=folder,
            cause="the pose estimation failed for this view, or the file is damaged",
            todo="drop the view from the model and the index files, or estimate its pose again",
        )
    if max(map(abs, image.quaternion)) < 1e-150:
        raise SceneError(
            f"the quaternion of image {image.name} is zero, which is no rotation",
            where=folder,
            cause="a pose that was never filled in",
            todo="drop the view from the model and the index files, or estimate its pose again",
        )


def _damaged(path: Path, what: str, cause: str = "the file is truncated or damaged") -> NoReturn:
    raise SceneError(what, where=path, cause=cause, todo="copy the file again or export the model again")


class _Bytes:
    """A reader that never goes past the end of its file."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        self.need(struct.calcsize(form))
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def need(self, size: int) -> None:
        left = len(self.data) - self.at
        if size > left:
            _damaged(self.path, f"{self.path.name} ends too early: {size} more bytes declared, {left} left")

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
            _damaged(self.path, f"{self.path.name} ends inside an image name")
        raw, self.at = self.data[self.at : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            _damaged(self.path, f"{self.path.name} holds an image name that is not UTF-8: {raw[:40]!r}")

    def finish(self) -> None:
        if self.at != len(self.data):
            _damaged(
                self.path, f"{self.path.name} goes on for {len(self.data) - self.at} bytes after its end"
            )


def _cameras_binary(path: Path) -> dict[int, Intrinsics]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(24 + 16)):
        camera_id, model_id, width, height = file.take("<IiQQ")
        if model_id not in MODELS:
            _damaged(
                path,
                f"camera {camera_id} has the unknown model id {model_id}",
                cause="a damaged file, or one written by a newer COLMAP",
            )
        name, parameters = MODELS[model_id]
        _add(cameras, camera_id, Intrinsics(name, width, height, file.take(f"<{parameters}d")), path)
    file.finish()
    return cameras


def _images_binary(path: Path) -> list[Registered]:
    file, images = _Bytes(path), {}
    for _ in range(file.count(4 + 56 + 4 + 1 + 8)):
        image_id, *pose, camera_id = file.take("<I7dI")
        name = file.string()
        file.skip(file.count(24) * 24)
        _add(images, image_id, Registered(name, tuple(pose[:4]), tuple(pose[4:]), camera_id), path)
    file.finish()
    return list(images.values())


def _add(table: dict, key: int, value, path: Path) -> None:
    if key in table:
        _damaged(path, f"{path.name} lists the id {key} twice", cause="a damaged or badly merged file")
    table[key] = value


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        _damaged(path, f"{path.name} is not text in UTF-8", cause="a binary or damaged file named .txt")


def _cameras_text(path: Path) -> dict[int, Intrinsics]:
    cameras: dict[int, Intrinsics] = {}
    known = dict(MODELS.values())
    for number, line in enumerate(_lines(path), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split()
        try:
            camera_id, model, width, height = int(fields[0]), fields[1], int(fields[2]), int(fields[3])
            params = tuple(map(float, fields[4:]))
        except (IndexError, ValueError):
            _damaged(path, f"line {number} is not `ID MODEL WIDTH HEIGHT PARAMS...`: {line.strip()[:80]!r}")
        if model in known and len(params) != known[model]:
            _damaged(path, f"line {number}: {model} needs {known[model]} parameters, {len(params)} given")
        _add(cameras, camera_id, Intrinsics(model, width, height, params), path)
    return cameras


def _images_text(path: Path) -> list[Registered]:
    images: dict[int, Registered] = {}
    # Every image has two lines, and the second (its 2D points) may be empty: blank lines count.
    lines = [(n, line) for n, line in enumerate(_lines(path), 1) if not line.lstrip().startswith("#")]
    at = 0
    while at < len(lines):
        number, line = lines[at]
        at += 1
        if not line.strip():
            continue
        fields = line.strip().split(maxsplit=9)
        try:
            image_id, camera_id, name = int(fields[0]), int(fields[8]), fields[9]
            pose = tuple(map(float, fields[1:8]))
        except (IndexError, ValueError):
            _damaged(
                path,
                f"line {number} is not `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`: {line.strip()[:80]!r}",
                cause="a damaged file, or the second line of an image (its points, often empty) was removed",
            )
        if at < len(lines):
            number, points = lines[at]
            at += 1
            if len(points.split()) % 3:
                _damaged(
                    path,
                    f"line {number} is not the list of 2D points of image {name}",
                    cause="the second line of an image (its points, often empty) was removed",
                )
        _add(images, image_id, Registered(name, pose[:4], pose[4:], camera_id), path)
    return list(images.values())
