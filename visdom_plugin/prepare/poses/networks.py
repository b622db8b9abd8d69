"""Cameras that networks estimate, as .npz or .json: VGGT, pi3, DUSt3R and MASt3R.

    VGGT     extrinsic (N, 3, 4) camera from world, intrinsic (N, 3, 3)
    pi3      camera_poses (N, 4, 4) camera to world, local_points (N, H, W, 3), which tell the focal length
    DUSt3R   poses or cams2world (N, 4, 4) camera to world, focals (N,), and principal_points (N, 2) or none

All have OpenCV's axes. Each network works on a small copy whose sides are multiples of 14 or 16: made smaller to
that width and cropped at the middle, or padded to a square. The arrays of pixels beside tell which copy it was.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from datamodules.files.parsers import damaged, parse_npy
from datamodules.files.paths import read_file
from visdom_plugin.errors import SceneError
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.prepare.poses.listed import Listed

_FROM_WORLD = ("extrinsic", "extrinsics", "world_to_camera", "w2c", "camera_from_world")
_TO_WORLD = (
    "camera_poses", "cams2world", "cam2world", "cam2worlds", "camera_to_world", "c2w", "poses", "im_poses"
)  # fmt: skip
_INTRINSICS = ("intrinsic", "intrinsics", "K", "Ks")
_FOCALS = ("focals", "focal", "im_focals")
_CENTRES = ("principal_points", "pps", "pp")
_NAMES = ("names", "image_names", "image_paths", "filenames")
_PIXELS = {
    "images": None,
    "imgs": None,
    "depth": None,
    "local_points": None,
    "world_points": None,
    "conf": None,
}
_SIZES = ("image_size", "image_sizes", "sizes", "hw")
_WHITE = 0.98
_MOST = 2**31


class _Copy(NamedTuple):
    """The small copy that a network saw."""

    width: int
    height: int
    padded: bool | None
    """Whether it was padded with white to a square; None where that cannot be told."""


def recognise(keys: Sequence[str]) -> bool:
    """Whether the names of a file's arrays are those of a network's cameras."""
    return any(k in keys for k in (*_FROM_WORLD, *_TO_WORLD)) and "frames" not in keys


def read_npz(path: Path, photographs: Sequence[Photograph]) -> Listed:
    """Cameras of a .npz file."""
    wanted = {*_FROM_WORLD, *_TO_WORLD, *_INTRINSICS, *_FOCALS, *_CENTRES, *_SIZES, *_PIXELS}
    found: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(path))) as archive:
            for info in archive.infolist():
                key = info.filename.removesuffix(".npy")
                if key in wanted and info.file_size < _MOST:
                    found[key] = parse_npy(archive.read(info), path / info.filename)
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        damaged(path, f"{path.name} is no archive of arrays: {error}")
    return read(found, None, path, photographs)


def read_json(content: Mapping[str, Any], path: Path, photographs: Sequence[Photograph]) -> Listed:
    """Cameras of a JSON object of the same names."""
    found = {}
    for key in (*_FROM_WORLD, *_TO_WORLD, *_INTRINSICS, *_FOCALS, *_CENTRES, *_SIZES):
        if content.get(key) is not None:
            try:
                found[key] = np.array(content[key], np.float64)
            except (TypeError, ValueError):
                damaged(path, f"{key} is no table of numbers")
    names = next((content[k] for k in _NAMES if isinstance(content.get(k), list)), None)
    return read(found, None if names is None else [str(n) for n in names], path, photographs)


def read(
    found: Mapping[str, np.ndarray], names: list[str] | None, path: Path, photographs: Sequence[Photograph]
) -> Listed:
    """Cameras of named arrays.

    Raises:
        SceneError: both directions of poses are there, or none; no focal length; or a copy of unknown crop.
    """
    poses, source = _poses(found, path)
    count = len(poses)
    copy = _copy(found, path)
    order = photographs if names is None else [*photographs]
    K, sizes, notes = np.zeros((count, 4)), [], []
    focal = _intrinsics(found, count, copy, path)
    for i in range(count):
        photograph = order[min(i, len(order) - 1)]
        upright = photograph.size[::-1] if photograph.orientation >= 5 else photograph.size
        if copy is None:
            size = _full_size(focal[i], photograph.size)
            K[i] = focal[i]
        else:
            # VGGT and pi3 read photographs as stored, DUSt3R upright: the copy's shape tells.
            size = min(
                (photograph.size, upright), key=lambda s: abs(np.log(s[0] / s[1] * copy.height / copy.width))
            )
            K[i] = _enlarge(focal[i], copy, size, path)
        sizes.append(size)
    if copy is not None:
        notes.append(
            f"{source}: intrinsics of a copy of {copy.width} x {copy.height} pixels, taken to the photographs'"
        )
    return Listed(source, names, K, sizes, poses, [None] * count, notes=notes)


def _poses(found: Mapping[str, np.ndarray], path: Path) -> tuple[np.ndarray, str]:
    """(N, 4, 4) camera to world."""
    from_world, to_world = (next((k for k in keys if k in found), None) for keys in (_FROM_WORLD, _TO_WORLD))
    if from_world is None and to_world is None:
        raise SceneError(
            f"there are no poses in {path.name}",
            where=path,
            todo=f"save them as {_FROM_WORLD[0]} (camera from world) or {_TO_WORLD[0]} (camera to world)",
            topic="poses",
        )
    key = from_world or to_world or ""
    raw = np.asarray(found[key], np.float64)
    raw = raw[0] if raw.ndim == 4 and len(raw) == 1 else raw
    if raw.ndim != 3 or raw.shape[1:] not in ((3, 4), (4, 4)) or not np.isfinite(raw).all():
        damaged(path, f"{key} has shape {raw.shape} or infinite numbers, and (N, 3, 4) or (N, 4, 4) is wanted",
                cause="another array of this name")  # fmt: skip
    motion = np.tile(np.eye(4), (len(raw), 1, 1))
    motion[:, :3] = raw[:, :3]
    source = "VGGT" if from_world else "pi3" if key == "camera_poses" else "DUSt3R"
    return np.linalg.inv(motion) if from_world else motion, source


def _copy(found: Mapping[str, np.ndarray], path: Path) -> _Copy | None:
    """The copy's size from the arrays of pixels beside; None where there are none."""
    for key in _SIZES:
        if key in found:
            height, width = np.asarray(found[key]).reshape(-1, 2)[0].astype(int)
            return _Copy(int(width), int(height), None)
    for key in _PIXELS:
        if key in found:
            array = np.asarray(found[key])
            array = array[0] if array.ndim == 5 and len(array) == 1 else array
            channels_first = array.ndim == 4 and array.shape[1] == 3 and array.shape[3] != 3
            height, width = array.shape[2:4] if channels_first else array.shape[1:3]
            padded = None
            if key in ("images", "imgs"):
                first = array[0].astype(np.float64).transpose(1, 2, 0) if channels_first else array[0]
                top = 255.0 if array.dtype == np.uint8 else 1.0
                edges = (first[:, 0], first[:, -1]), (first[0], first[-1])
                padded = any(min(float(e.min()) for e in pair) > _WHITE * top for pair in edges)
            return _Copy(int(width), int(height), padded)
    return None


def _intrinsics(found: Mapping[str, np.ndarray], count: int, copy: _Copy | None, path: Path) -> np.ndarray:
    """(N, 4) fx, fy, cx, cy in the copy's pixels, or the photographs' where there is no copy."""
    key = next((k for k in _INTRINSICS if k in found), None)
    if key is not None:
        K = np.asarray(found[key], np.float64).reshape(-1, 3, 3)
        K = np.broadcast_to(K, (count, 3, 3)) if len(K) == 1 else K
        if len(K) != count:
            damaged(path, f"{key} is of {len(K)} cameras, the poses of {count}")
        return np.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], -1)
    focal = next((np.asarray(found[k], np.float64).reshape(-1) for k in _FOCALS if k in found), None)
    if focal is None and "local_points" in found:
        focal = _focal_of_points(np.asarray(found["local_points"]))
    if focal is None or copy is None:
        raise SceneError(
            f"{path.name} has poses and no focal length in known pixels",
            where=path,
            cause="only a part of what the network found was saved",
            todo="save intrinsic (N, 3, 3), or focals with images; of pi3 camera_poses and local_points",
            topic="poses",
        )
    focal = np.broadcast_to(focal, (count,)) if len(focal) == 1 else focal
    if len(focal) != count:
        damaged(path, f"focal lengths are of {len(focal)} cameras, the poses of {count}")
    centre = np.tile([copy.width / 2, copy.height / 2], (count, 1))
    for key in _CENTRES:
        if key in found:
            centre = np.asarray(found[key], np.float64).reshape(count, 2)
    return np.stack([focal, focal, centre[:, 0], centre[:, 1]], -1)


def _focal_of_points(points: np.ndarray) -> np.ndarray:
    """(N,) focal lengths in pixels from points (N, H, W, 3) in the cameras' frames, centred."""
    points = points[0] if points.ndim == 5 else points
    height, width = points.shape[1:3]
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    found = []
    for p in points.astype(np.float64):
        x, y, z = p[..., 0], p[..., 1], np.maximum(p[..., 2], 1e-9)
        slope, pixel = np.hypot(x / z, y / z), np.hypot(u, v)
        far = pixel > 0.2 * max(width, height)
        found.append(float(np.median(pixel[far] / np.maximum(slope[far], 1e-9))))
    return np.array(found)


def _enlarge(focal: np.ndarray, copy: _Copy, size: tuple[int, int], path: Path) -> np.ndarray:
    """fx, fy, cx, cy in a photograph's pixels from those in its copy."""
    width, height = size
    fx, fy, cx, cy = focal
    even = min(abs(copy.width / width * height - copy.height), abs(copy.height / height * width - copy.width))
    if copy.width == copy.height and width != height:
        if copy.padded is None or (copy.padded is False and height < width):
            raise SceneError(
                f"the network saw squares of {copy.width} pixels, and whether photographs of {width} x {height} "
                "were cropped or padded for that cannot be told",
                where=path,
                cause="the arrays of pixels (images) were not saved beside the cameras",
                todo="save images, too; or export COLMAP's format, which the network's scripts write",
                topic="poses",
            )
        if copy.padded:
            scale = max(width, height) / copy.width
            off = (copy.width - width / scale) / 2, (copy.height - height / scale) / 2
            return np.array([fx, fy, cx - off[0], cy - off[1]]) * scale
    if even <= max(8, copy.height % 1):
        # Sides rounded to multiples of the network's patches, each axis by its own ratio.
        return np.array([fx, fy, cx, cy]) * np.array([width / copy.width, height / copy.height] * 2)
    # Cropped at the middle, evenly resized.
    scale = min(width / copy.width, height / copy.height)
    off = (width / scale - copy.width) / 2, (height / scale - copy.height) / 2
    return np.array([fx, fy, cx + off[0], cy + off[1]]) * scale


def _full_size(focal: np.ndarray, size: tuple[int, int]) -> tuple[int, int]:
    """The size that intrinsics without a copy speak of: the photograph's, or turned where the centre says so."""
    centre = focal[2:] / np.array(size)
    other = focal[2:] / np.array(size[::-1])
    return size if abs(centre - 0.5).max() <= abs(other - 0.5).max() else size[::-1]
