"""LLFF scenes: poses_bounds.npy beside a folder of photographs.

poses_bounds.npy   N x 17: a 3 x 5 matrix per photograph, then near and far depth. Columns of the matrix: the
                   camera's down, right and backward axes and its position in the world, then height, width
                   and focal length in pixels. The principal point is the image's centre.
images/            N photographs, matched to the rows in the order of their names; images_<F>/ smaller ones
masks/             foreground masks named after the photographs; or alpha channels
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from datamodules.capture import Calibration, Capture, Frame, sort_frames
from datamodules.files.images import is_image_name
from datamodules.files.parsers import damaged, parse_npy
from datamodules.files.paths import check_name, inside, read_inside
from datamodules.files.pinholes import pinholes
from datamodules.request import Request
from datamodules.views import splits
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras

FILE = "poses_bounds.npy"


def recognise(root: Path) -> str | None:
    """poses_bounds.npy, or None."""
    return FILE if (root / FILE).exists() else None


def read(root: Path, request: Request) -> Capture:
    """Reads poses_bounds.npy; every 8th view is for testing."""
    return read_capture(root, request, "llff")


def parse_poses_bounds(data: bytes, path: Path) -> np.ndarray:
    """(N, 17) float64; NaN and infinities are left to `cameras_of`, which sees the rows in use alone.

    Raises:
        SceneError: not a numeric array of this shape.
    """
    table = parse_npy(data, path)
    if table.ndim != 2 or table.shape[1] != 17 or not len(table):
        damaged(
            path,
            f"{path.name} holds an array of {table.shape}, not N x 17",
            cause="another file of this name",
        )
    return table.astype(np.float64)


def cameras_of(rows: np.ndarray, names: Sequence[str], path: Path) -> Cameras:
    """Cameras of rows (N, 17), at the size that they say.

    Raises:
        SceneError: impossible sizes, focal lengths or poses, by name.
    """
    table = rows[:, :15].reshape(-1, 3, 5)
    sizes = [_size(hwf, path) for hwf in table[:, :, 4]]
    focal = table[:, 2, 4]
    centres = np.array(sizes, np.float64).reshape(-1, 2) / 2
    # Right, down, forward from down, right, backward.
    pose = np.stack([table[:, :, 1], table[:, :, 0], -table[:, :, 2], table[:, :, 3]], -1)
    K = np.stack([focal, focal, centres[:, 0], centres[:, 1]], -1)
    return pinholes(K, pose, sizes, names=names, where=path)


def read_capture(
    root: Path, request: Request, layout: str, *, file: str = FILE, mask_folder: str = "masks"
) -> Capture:
    """A capture of a poses_bounds file and a folder `images`.

    Raises:
        SceneError: the file is damaged, or there are more or fewer photographs than rows.
    """
    path = root / file
    table = parse_poses_bounds(read_inside(root, file, outside=request.allow_outside), path)
    names = _list_photographs(root, request)
    if len(names) != len(table):
        raise SceneError(
            f"{file} has {len(table)} rows, but there are {len(names)} photographs",
            where=root,
            cause="photographs that were not registered are still in the folder, or the copy is not complete",
            todo="keep exactly the photographs that the poses were estimated for, in the order of their names",
            topic="poses",
        )
    row_of = {name: i for i, name in enumerate(names)}
    frames = sort_frames([Frame(name, f"images/{name}") for name in names])

    def calibrate(wanted: Sequence[int]) -> Calibration:
        names_of = [frames[i].name for i in wanted]
        cameras = cameras_of(table[[row_of[name] for name in names_of]], names_of, path)
        return Calibration(cameras, [None] * len(cameras))

    return Capture(
        root,
        layout,
        frames,
        calibrate,
        splits.every_eighth(range(len(frames))),
        (file,),
        photographs="images",
        mask_folder=mask_folder,
        notes=(f"poses of {file}: the principal point is taken to be the centre of each image",),
    )


def _list_photographs(root: Path, request: Request) -> list[str]:
    """By the names in images/, or in a smaller copy where only such are there."""
    folders = ["images", *sorted(p.name for p in root.glob("images_*"))]
    for name in folders:
        folder = inside(root, name, outside=request.allow_outside)
        if folder.is_dir():
            found = sorted(p.name for p in folder.iterdir() if is_image_name(PurePath(p.name)))
            for file in found:
                check_name(file, folder)
            return found
    raise SceneError(
        "the folder images is missing", where=root, todo="put the photographs there", topic="photograph"
    )


def _size(hwf: np.ndarray, path: Path) -> tuple[int, int]:
    height, width = (float(v) for v in hwf[:2])
    if not all(1 <= v <= 1e6 and v == round(v) for v in (height, width)):
        damaged(path, f"{path.name} says an image has {width:g} x {height:g} pixels")
    return int(width), int(height)
