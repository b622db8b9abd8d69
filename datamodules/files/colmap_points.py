"""The 3D points of COLMAP's sparse models, text and binary. Tracks are passed over."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datamodules.files.colmap_model import ByteReader, text_lines
from datamodules.files.parsers import damaged
from datamodules.files.paths import read_inside


class Points(NamedTuple):
    """Triangulated points."""

    xyz: np.ndarray
    """(P, 3) float64 world frame."""
    rgb: np.ndarray
    """(P, 3) uint8."""


def find_points(root: Path, folder: str) -> str | None:
    """The model's file of points below `root`, binary before text; None where there is none."""
    names = (f"{folder}/points3D{suffix}".lstrip("/") for suffix in (".bin", ".txt"))
    return next((name for name in names if (root / name).is_file()), None)


def read_points(root: Path, name: str, *, outside: bool = False) -> Points:
    """The points in a file below `root`.

    Raises:
        SceneError: the file leads outside, or is truncated or damaged.
    """
    parse = parse_points_binary if name.endswith(".bin") else parse_points_text
    return parse(read_inside(root, name, outside=outside), root / name)


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
        np.frombuffer(data, np.uint8)[starts[:, None] + np.arange(8, 35)]
        if count
        else np.zeros((0, 27), np.uint8)
    )
    return _points(raw[:, :24].copy().view("<f8"), raw[:, 24:].copy(), path)


def _points(xyz: np.ndarray, rgb: np.ndarray, path: Path) -> Points:
    if not np.isfinite(xyz).all():
        damaged(path, f"{path.name} holds points at NaN or infinite places")
    return Points(xyz, rgb)


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
    return _points(table[:, :3], table[:, 3:6].astype(np.uint8), path)
