"""A capture as other programs read it: cleaned pictures, masks, cameras in two formats, and a hull to start from.

    images/NAME.png     RGBA, transparent beside the object       masks/NAME.png   white on the object
    transforms.json     nerfstudio, instant-ngp, Brush            sparse/0/        COLMAP: LichtFeld, Brush, 3DGS
    hull.ply            the hull's mesh                           sparse_pc.ply    points on it, with colours

All are in the capture's own frame, or in the one it is moved to.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datamodules.recognise import REPEATED_BY
from visdom_plugin.atomic_files import write_bytes, write_json
from visdom_plugin.export.meshes import Mesh, move
from visdom_plugin.figures.contact_sheet import picture_names, write_png
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.mesh_files import mesh_ply
from visdom_plugin.geometry.rotations import quaternion_from_matrix
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.point_colours import colour_points
from visdom_plugin.scene import Scene, Views
from visdom_plugin.seeding import generator

POINTS = 20_000
_MODEL = "sparse/0"
_PINHOLE = 1
"""COLMAP's number of the camera model without distortion."""


def write_dataset(folder: Path, scene: Scene, hull: Hull | None, motion: Tensor | None = None) -> list[Path]:
    """Writes all of it; returns the files and folders.

    Args:
        folder: an empty or a new one.
        hull: of the training views; without it no points and no mesh are written.
        motion: (4, 4) float64 rigid motion of the world; None for the capture's own frame.
    """
    motion = torch.eye(4, dtype=torch.float64) if motion is None else motion
    cameras, names, frames = [], [], []
    for part, views in (("train", scene.train), ("test", scene.test)):
        for i, stem in enumerate(picture_names(views.names)):
            name = f"{stem}.png" if part == "train" or f"{stem}.png" not in names else f"test_{stem}.png"
            _write_view(folder, name, views, i)
            camera = views.cameras[i].to("cpu", torch.float64)
            pose = motion @ camera.world_from_camera
            cameras.append(Cameras(camera.intrinsics, pose, camera.width, camera.height))
            names.append(name)
            frames.append(part)
    points = _points(hull, scene.train, motion) if hull is not None else None
    write_transforms(folder, cameras, names, frames, points is not None, _MODEL)
    write_colmap(folder / _MODEL, cameras, names, points)
    made = [folder / name for name in ("images", "masks", "transforms.json", _MODEL)]
    if hull is not None and points is not None:
        mesh = move(Mesh(*hull.to_mesh()), motion.numpy())
        write_bytes(folder / "hull.ply", mesh_ply(*mesh))
        write_bytes(folder / "sparse_pc.ply", mesh_ply(points[0], np.zeros((0, 3), np.int64), points[1]))
        made += [folder / "hull.ply", folder / "sparse_pc.ply"]
    return made


def _write_view(folder: Path, name: str, views: Views, i: int) -> None:
    image = np.asarray(views.images[i])
    mask = np.asarray(views.masks[i])
    alpha = np.where(mask, 255, 0).astype(np.uint8)
    write_png(folder / "images" / name, np.concatenate([image * mask[..., None], alpha[..., None]], -1))
    write_png(folder / "masks" / name, alpha)


def _points(hull: Hull, views: Views, motion: Tensor) -> tuple[np.ndarray, np.ndarray]:
    drawn = hull.sample_points(POINTS, generator(0, "points of a data set"))
    rgb = colour_points(hull, drawn, views.cameras, list(views.images))
    moved = drawn @ motion[:3, :3].mT + motion[:3, 3]
    return moved.numpy(), (rgb * 255).round().byte().numpy()


def write_transforms(
    folder: Path,
    cameras: list[Cameras],
    names: list[str],
    parts: list[str] | None = None,
    points: bool = False,
    model: str | None = None,
) -> None:
    """Writes transforms.json of pictures in `folder/images`.

    Args:
        cameras: one per picture.
        names: of the pictures, with their ending.
        parts: "train" or "test" for each; None leaves the split to who reads it.
        points: whether sparse_pc.ply lies beside.
        model: the COLMAP model beside it with the same cameras, so that the folder has one reading.
    """
    frames = []
    for camera, name in zip(cameras, names, strict=True):
        K = camera.intrinsics
        frames.append(
            {
                "file_path": f"images/{name}",
                "fl_x": float(K[0, 0]),
                "fl_y": float(K[1, 1]),
                "cx": float(K[0, 2]),
                "cy": float(K[1, 2]),
                "w": int(camera.width),
                "h": int(camera.height),
                # OpenGL's axes: y up, z back.
                "transform_matrix": (
                    camera.world_from_camera * torch.tensor([1.0, -1.0, -1.0, 1.0])
                ).tolist(),
            }
        )
    content: dict[str, Any] = {"camera_model": "OPENCV", "frames": frames}
    for part in ("train", "test") if parts is not None else ():
        content[f"{part}_filenames"] = [
            f"images/{n}" for n, p in zip(names, parts or (), strict=True) if p == part
        ]
    if points:
        content["ply_file_path"] = "sparse_pc.ply"
    if model is not None:
        content[REPEATED_BY] = model
    write_json(folder / "transforms.json", content)


def write_colmap(
    folder: Path,
    cameras: list[Cameras],
    names: list[str],
    points: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Writes a binary COLMAP model of pinhole cameras, one per picture.

    Args:
        cameras: float64, one per picture.
        names: of the pictures, below the folder of pictures.
        points: (P, 3) positions and (P, 3) uint8 colours; None writes an empty file of them.
    """
    lenses, images = [struct.pack("<Q", len(cameras))], [struct.pack("<Q", len(cameras))]
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        K, world = camera.intrinsics, camera.camera_from_world
        size = int(camera.width), int(camera.height)
        focal = (float(K[j, k]) for j, k in ((0, 0), (1, 1), (0, 2), (1, 2)))
        lenses.append(struct.pack("<iiQQ4d", i, _PINHOLE, *size, *focal))
        pose = (*quaternion_from_matrix(world[:3, :3]).tolist(), *world[:3, 3].tolist())
        images.append(struct.pack("<i7di", i, *pose, i) + name.encode() + b"\0" + struct.pack("<Q", 0))
    write_bytes(folder / "cameras.bin", b"".join(lenses))
    write_bytes(folder / "images.bin", b"".join(images))
    xyz, rgb = points if points is not None else (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    record = np.dtype(
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    )
    table = np.zeros(len(xyz), record)
    table["id"], table["xyz"], table["rgb"] = np.arange(1, len(xyz) + 1), xyz, rgb
    write_bytes(folder / "points3D.bin", struct.pack("<Q", len(xyz)) + table.tobytes())
