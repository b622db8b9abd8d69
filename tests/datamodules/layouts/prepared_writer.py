"""Writes scenes in GaussianObject's prepared layout, as text or binary, for the tests."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import torch

from visdom_plugin.geometry.rotations import quaternion_from_matrix
from visdom_plugin.scene import Scene


def write_prepared(scene: Scene, folder: Path, *, binary: bool = False, simple: bool = False) -> Path:
    """The scene as images/*.png, masks/, sparse/0, sparse_<N>.txt and sparse_test.txt.

    The model lists the images in reverse, with ids that leave gaps and a 2D point each, so that a reader
    that trusts the order of the file or skips no points fails. `simple` writes SIMPLE_PINHOLE.
    """
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    rows, ordered = [], []
    for views in (scene.train, scene.test):
        for i, name in enumerate(views.names):
            image, mask = views.images[i].numpy(), views.masks[i].numpy()
            write(folder / "images" / f"{name}.png", image[..., ::-1])
            write(folder / "masks" / f"{name}.png", mask.astype(np.uint8) * 255)
            camera = views.cameras[i]
            world = camera.camera_from_world
            K = camera.intrinsics
            params = (K[0, 0], K[0, 2], K[1, 2]) if simple else (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            pose = [*quaternion_from_matrix(world[:3, :3]).tolist(), *world[:3, 3].tolist()]
            rows.append(
                (f"{name}.png", pose, [float(p) for p in params], int(camera.width), int(camera.height))
            )
            ordered.append(name)
    position = {name: i for i, name in enumerate(sorted(ordered))}
    for views, label in ((scene.train, str(len(scene.train))), (scene.test, "test")):
        text = "".join(f"{position[name]}\n" for name in views.names)
        (folder / f"sparse_{label}.txt").write_text(text)
    write_model(folder / "sparse/0", rows[::-1], binary, "SIMPLE_PINHOLE" if simple else "PINHOLE")
    return folder


def write_model(folder: Path, rows, binary: bool, model: str) -> None:
    if binary:
        model_id = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1}[model]
        cameras, images = [struct.pack("<Q", len(rows))], [struct.pack("<Q", len(rows))]
        for i, (name, pose, params, width, height) in enumerate(rows):
            cameras.append(struct.pack("<IiQQ", 3 * i + 2, model_id, width, height))
            cameras.append(struct.pack(f"<{len(params)}d", *params))
            images.append(struct.pack("<I7dI", 2 * i + 5, *pose, 3 * i + 2) + name.encode() + b"\0")
            images.append(struct.pack("<QddQ", 1, 3.5, 4.5, 2**64 - 1))
        (folder / "cameras.bin").write_bytes(b"".join(cameras))
        (folder / "images.bin").write_bytes(b"".join(images))
        return
    cameras, images = ["# comment"], ["# comment", "# another"]
    for i, (name, pose, params, width, height) in enumerate(rows):
        cameras.append(f"{3 * i + 2} {model} {width} {height} " + " ".join(map(repr, params)))
        images.append(f"{2 * i + 5} " + " ".join(map(repr, pose)) + f" {3 * i + 2} {name}")
        images.append("" if i % 2 else "3.5 4.5 -1")
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def write(path: Path, pixels: np.ndarray) -> None:
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels))


def same_cameras(a, b, tolerance: float = 0.0) -> bool:
    pairs = [(getattr(a, n), getattr(b, n)) for n in ("intrinsics", "world_from_camera")]
    sizes = torch.equal(a.width, b.width) and torch.equal(a.height, b.height)
    return sizes and all(torch.allclose(x, y, rtol=0, atol=tolerance) for x, y in pairs)
