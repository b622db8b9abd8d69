"""Captures of IDR and NeuS: projection matrices in one .npz beside photographs and masks.

cameras_sphere.npz       (cameras_large.npz, cameras.npz) world_mat_<i>: 4 x 4, whose upper 3 x 4 projects the
                         world to pixels; scale_mat_<i>, which moves the object into the unit ball, is not used
image/ (images/, rgb/)   photographs, the i-th by name belongs to the i-th matrix
mask/ (masks/)           as many foreground masks, in the same order, or named like the photographs
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from datamodules.capture import Calibration, Capture, Frame, sort_frames
from datamodules.files import images
from datamodules.files.parsers import damaged, parse_npy
from datamodules.files.paths import check_name, inside, printable, read_file, read_inside
from datamodules.files.pinholes import pinholes
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.mask_files import OTHER_FOLDERS
from visdom_plugin.errors import SceneError

_FILES = ("cameras_sphere.npz", "cameras_large.npz", "cameras.npz")
_MOST_BYTES = 2**16
"""No matrix takes more."""


def recognise(root: Path) -> str | None:
    """The file of matrices, or None."""
    return next((name for name in _FILES if (root / name).exists()), None)


def read(root: Path, request: Request) -> Capture:
    """Reads the matrices; every 8th view is for testing.

    Raises:
        SceneError: the file is missing or damaged, or there are more or fewer photographs than matrices.
    """
    file = recognise(root) or _FILES[0]
    path = root / file
    matrices = parse_projections(read_inside(root, file, outside=request.allow_outside, most=2**26), path)
    folder = next((name for name in ("image", "images", "rgb") if (root / name).is_dir()), "image")
    photographs = _list_images(root, folder, request)
    if len(photographs) != len(matrices):
        raise SceneError(
            f"{file} has {len(matrices)} matrices, but {folder} holds {len(photographs)} photographs",
            where=root,
            cause="the copy is not complete, or photographs were added or left out",
            todo="keep exactly the photographs that the matrices were made for, in the order of their names",
            topic="poses",
        )
    places = [request.masks] if request.masks else ["mask", "masks", *OTHER_FOLDERS]
    mask_folder = next((name for name in places if (root / name).is_dir()), "mask")
    masks = _list_images(root, mask_folder, request)
    # DTU's masks are 000.png for photographs 000000.png: their order tells.
    ordered = len(masks) == len(photographs)
    at = {name: i for i, name in enumerate(photographs)}
    frames = sort_frames(
        [
            Frame(name, f"{folder}/{name}", mask=f"{mask_folder}/{masks[i]}" if ordered else None)
            for name, i in at.items()
        ]
    )

    def calibrate(wanted: Sequence[int]) -> Calibration:
        names = [frames[i].name for i in wanted]
        found = [decompose(matrices[at[name]], name, path) for name in names]
        sizes = []
        for i in wanted:
            photograph = inside(root, frames[i].image, outside=request.allow_outside)
            sizes.append(images.read_header(read_file(photograph), photograph).size)
        cameras = pinholes([K for K, _ in found], [pose for _, pose in found], sizes, names=names, where=path)
        return Calibration(cameras, [None] * len(cameras))

    return Capture(
        root,
        "neus",
        frames,
        calibrate,
        splits.every_eighth(range(len(frames))),
        (file,),
        photographs=folder,
        mask_folder=mask_folder,
        notes=(f"projection matrices of {file}, the i-th for the i-th photograph by name",),
    )


def parse_projections(data: bytes, path: Path) -> list[np.ndarray]:
    """(4, 4) float64 world_mat_<i> of an .npz file, by rising i.

    Raises:
        SceneError: no archive of arrays, no such matrix in it, or a gap in their numbers.
    """
    matrices: dict[int, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for entry in archive.infolist():
                if found := re.fullmatch(r"world_mat_(\d{1,6})\.npy", entry.filename):
                    with archive.open(entry) as member:
                        matrices[int(found[1])] = parse_npy(member.read(_MOST_BYTES), path)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OSError) as error:
        damaged(path, f"{path.name} is no archive of NumPy arrays: {str(error)[:100]}")
    if not matrices:
        damaged(path, f"{path.name} holds no world_mat_<i>", cause="another file of this name")
    for i, key in enumerate(sorted(matrices)):
        if key != i:
            damaged(path, f"{path.name} has world_mat_{key}, but no world_mat_{i}")
        if matrices[i].shape not in ((4, 4), (3, 4)) or not np.isfinite(matrices[i]).all():
            damaged(path, f"world_mat_{i} is no 4 x 4 matrix of finite numbers")
    return [matrices[i].astype(np.float64) for i in range(len(matrices))]


def decompose(matrix: np.ndarray, name: str, path: Path) -> tuple[list[float], np.ndarray]:
    """Intrinsics fx, fy, cx, cy and the (3, 4) camera-to-world pose, OpenCV axes, of a projection matrix.

    Raises:
        SceneError: the matrix projects nothing, or its pixels are skewed.
    """
    matrix = matrix[:3] / max(np.abs(matrix[:3, :3]).max(), 1e-300)
    part = matrix[:, :3]
    if not abs(np.linalg.det(part)) > 1e-12:
        raise SceneError(
            f"the matrix of {printable(name)} is no projection to pixels",
            where=path,
            cause="a pose in place of the product of intrinsics and pose",
            todo="write intrinsics @ world-to-camera as world_mat_<i>",
            topic="poses",
        )
    # RQ by QR of the turned matrix; signs such that all focal lengths are positive.
    turned, triangle = np.linalg.qr(part[::-1].T)
    K, rotation = triangle.T[::-1, ::-1], turned.T[::-1]
    signs = np.sign(np.diag(K))
    K, rotation = K * signs, rotation * signs[:, None]
    if np.linalg.det(rotation) < 0:
        rotation = -rotation
    K = K / K[2, 2]
    if abs(K[0, 1]) > 0.01 * K[0, 0]:
        raise SceneError(
            f"the camera of {printable(name)} has skewed pixels (skew {K[0, 1]:.4g}, focal length {K[0, 0]:.4g})",
            where=path,
            cause="a matrix that is no product of intrinsics and world-to-camera pose",
            todo="write intrinsics @ world-to-camera as world_mat_<i>",
            topic="lens",
        )
    centre = -np.linalg.solve(part, matrix[:, 3])
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.concatenate([rotation.T, centre[:, None]], 1)


def _list_images(root: Path, folder: str, request: Request) -> list[str]:
    path = inside(root, folder, outside=request.allow_outside)
    found = (
        sorted(p.name for p in path.iterdir() if images.is_image_name(PurePath(p.name)))
        if path.is_dir()
        else []
    )
    for name in found:
        check_name(name, path)
    return found
