"""ActorsHQ's calibration.csv, written: a row per camera, lengths as fractions of the image."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import quaternion_from_matrix

COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def write_calibration(path: Path, cameras: Cameras, names: Sequence[str]) -> None:
    """Writes the table.

    Args:
        cameras: (N,) float64.
        names: of the cameras.
    """
    size = torch.stack([cameras.width, cameras.height], -1)
    K = cameras.intrinsics
    focal, centre = K[:, [0, 1], [0, 1]] / size, K[:, :2, 2] / size
    turn = _rotation_vector(cameras.world_from_camera[:, :3, :3])
    numbers = torch.cat([turn, cameras.centres, focal, centre], -1).double().tolist()
    out = io.StringIO(newline="")
    table = csv.writer(out, lineterminator="\n")
    table.writerow(COLUMNS)
    # repr has all digits of a float64.
    table.writerows(
        [name, *wh, *map(repr, row)] for name, wh, row in zip(names, size.tolist(), numbers, strict=True)
    )
    write_bytes(path, out.getvalue().encode())


def _rotation_vector(rotation: Tensor) -> Tensor:
    """(N, 3) axis times angle, at most half a turn, of rotation matrices (N, 3, 3)."""
    w, axis = quaternion_from_matrix(rotation).split([1, 3], -1)
    sine = axis.norm(dim=-1, keepdim=True)
    # atan2(s, w) / s, whose limit at no rotation is 1.
    angle = torch.where(sine > 1e-12, 2 * torch.atan2(sine, w) / sine.clamp_min(1e-300), 2.0)
    return axis * angle
