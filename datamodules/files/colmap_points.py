"""The 3D points of COLMAP's sparse models, text and binary. Tracks are passed over."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datamodules.files.colmap_model import ByteReader, text_lines
from datamodules.files.parsers import damaged
from datamodules.files.paths import inside, read_inside


class Points(NamedTuple):
    """Triangulated points."""

    xyz: np.ndarray
    """(P, 3) float64 world frame."""
    rgb: np.ndarray
    """(P, 3) uint8."""
    error: np.ndarray
    """(P,) float64 mean reprojection error in pixels."""


def read_points(root: Path, folder: str, *, outside: bool = False) -> Points | None:
    """The model's points3D, binary before text; None where there is no such file."""
    for suffix, parse in ((".bin", parse_points_binary), (".txt", parse_points_text)):
        name = f"{folder}/points3D{suffix}".lstrip("/")
        path = inside(root, name, outside=outside)
        if path.is_file():
            return parse(read_inside(root, name, outside=outside), path)
    return None


def parse_points_binary(data: bytes, path: Path) -> Points:
    """Of points3D.bin, by gathering fixed fields at the offsets that the track lengths give."""
    file = ByteReader(data, path)
    count, at, end = file.count(8 + 24 + 3 + 8 + 8), 8, len(data)
    starts, length = np.empty(count, np.int64), struct.Struct("<Q").unpack_from
    for i in range(count):
        if at + 51 > end:
            file.at = at
            file.need(51)
        starts[i] = at
        at += 51 + 8 * length(data, at + 43)[0]
    file.at = min(at, end)
    file.need(at - file.at)
    file.finish()
    raw = (
        np.frombuffer(data, np.uint8)[starts[:, None] + np.arange(8, 43)]
        if count
        else np.zeros((0, 35), np.uint8)
    )
    return _points(
        raw[:, :24].copy().view("<f8"), raw[:, 24:27].copy(), raw[:, 27:].copy().view("<f8")[:, 0], path
    )


def _points(xyz: np.ndarray, rgb: np.ndarray, error: np.ndarray, path: Path) -> Points:
    if not np.isfinite(xyz).all():
        damaged(path, f"{path.name} holds points at NaN or infinite places")
    return Points(xyz, rgb, error)


def parse_points_text(data: bytes, path: Path) -> Points:
    """Of points3D.txt; tracks are not read."""
    rows = []
    for number, line in enumerate(text_lines(data, path), 1):
        fields = line.split(maxsplit=8)
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = list(map(float, fields[1:8]))
            fine = len(row) == 7 and all(0 <= c <= 255 for c in row[3:6])
        except ValueError:
            fine = False
        if not fine:
            damaged(path, f"line {number} is not `ID X Y Z R G B ERROR TRACK...`: {line.strip()[:80]!r}")
        rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 7)
    return _points(table[:, :3], table[:, 3:6].astype(np.uint8), table[:, 6], path)
