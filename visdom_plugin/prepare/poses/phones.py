"""Cameras that phones track themselves (ARKit): Record3D, Polycam's raw data, 3D Scanner App.

All give camera-to-world poses with ARKit's axes, which are OpenGL's (x right, y up, z backward), in metres, for
pictures as the sensor has them; the lens is a pinhole.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datamodules.files.parsers import damaged, number, parse_json, size
from datamodules.files.paths import read_file
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.prepare.poses.listed import Listed


def is_record3d(content: dict[str, Any]) -> bool:
    """Whether a JSON object is Record3D's metadata."""
    return "poses" in content and "K" in content and "w" in content


def read_record3d(content: dict[str, Any], path: Path) -> Listed:
    """Record3D: pictures rgb/0.jpg and so on; poses as x y z w of a quaternion and a position; K by columns."""
    poses = _array(content["poses"], (-1, 7), "poses", path)
    count = len(poses)
    wide, high = size(content["w"], "w", path), size(content["h"], "h", path)
    own = content.get("perFrameIntrinsicCoeffs")
    if own:
        K = _array(own, (count, 4), "perFrameIntrinsicCoeffs", path)
    else:
        flat = _array(content["K"], (9,), "K", path)
        K = np.tile([flat[0], flat[4], flat[6], flat[7]], (count, 1))
    motions = np.zeros((count, 3, 4))
    w_first = torch.from_numpy(np.ascontiguousarray(poses[:, [3, 0, 1, 2]]))
    motions[:, :, :3] = matrix_from_quaternion(w_first / w_first.norm(dim=-1, keepdim=True)).numpy()
    motions[:, :, 3] = poses[:, 4:]
    names = [f"{i}.jpg" for i in range(count)]
    return Listed("Record3D", names, K, [(wide, high)] * count, motions, [None] * count, "opengl", "metres")


def is_polycam(content: dict[str, Any]) -> bool:
    """Whether a JSON object is one camera of Polycam."""
    return "t_00" in content and "fx" in content


def is_scanner(content: dict[str, Any]) -> bool:
    """Whether a JSON object is one frame of 3D Scanner App."""
    return "cameraPoseARFrame" in content and "intrinsics" in content


def read_folder(paths: Sequence[Path], photographs: Sequence[Photograph]) -> Listed | None:
    """One JSON file per photograph, of Polycam or 3D Scanner App, named as it; None where there are none."""
    sizes_of = {p.path.stem: p.size for p in photographs}
    names, K, poses, source = [], [], [], ""
    sizes: list[tuple[int, int] | None] = []
    for path in paths:
        content = parse_json(read_file(path), path)
        if is_polycam(content):
            source = "Polycam"
            poses.append(
                [[number(content.get(f"t_{r}{c}"), f"t_{r}{c}", path) for c in range(4)] for r in range(3)]
            )
            K.append([number(content.get(k), k, path) for k in ("fx", "fy", "cx", "cy")])
            sizes.append(
                (size(content.get("width"), "width", path), size(content.get("height"), "height", path))
            )
        elif is_scanner(content):
            source = "3D Scanner App"
            poses.append(_array(content["cameraPoseARFrame"], (4, 4), "cameraPoseARFrame", path)[:3].tolist())
            k = _array(content["intrinsics"], (9,), "intrinsics", path)
            K.append([k[0], k[4], k[2], k[5]])
            sizes.append(sizes_of.get(path.stem))
        else:
            continue
        names.append(path.stem)
    if not names:
        return None
    return Listed(source, names, np.array(K), sizes, np.array(poses), [None] * len(names), "opengl", "metres")


def _array(value: Any, shape: tuple[int, ...], what: str, path: Path) -> np.ndarray:
    try:
        array = np.array(value, np.float64).reshape(shape)
    except (TypeError, ValueError):
        damaged(path, f"{what} is no table of numbers of shape {shape}")
    if not np.isfinite(array).all():
        damaged(path, f"{what} holds NaN or infinite numbers")
    return array
