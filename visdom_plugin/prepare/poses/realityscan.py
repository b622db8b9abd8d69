"""RealityScan's (RealityCapture's) cameras: the CSV of internal and external parameters, and XMP files.

Focal lengths are those on 36 mm for the longer side of the image. The CSV has heading, pitch and roll of a camera
in a world whose z points up; XMP files beside the photographs have the rotation from world to camera, x right, y
down, z forward.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datamodules.files.parsers import csv_number, damaged, parse_csv
from datamodules.files.paths import read_file
from datamodules.files.undistort import Distortion
from visdom_plugin.errors import SceneError
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.prepare.poses.listed import Listed

COLUMNS = ("x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM_MM = 36.0


def recognise_csv(data: bytes) -> bool:
    """Whether a CSV file begins as RealityScan's."""
    first = data[:4096].decode("utf-8-sig", "replace").partition("\n")[0].lower()
    return first.startswith(("#name", "#cameras", "name,")) or "heading" in first


def read_csv(data: bytes, path: Path, photographs: Sequence[Photograph]) -> Listed:
    """The cameras of the CSV.

    Args:
        photographs: whose sizes tell what focal lengths are in pixels.
    """
    data = re.sub(rb"\A(\xef\xbb\xbf)?#cameras[^\n]*\n", b"", data)
    data = re.sub(rb"\A(\xef\xbb\xbf)?#", b"", data)
    rows = parse_csv(data, path, ("name", *COLUMNS))
    if not rows:
        damaged(path, "the file lists no cameras", cause="nothing was aligned when it was exported")
    size = photographs[0].size
    longer = max(size)
    if any(sorted(p.size) != sorted(size) for p in photographs):
        raise SceneError(
            "the photographs are of different sizes, and this file says none",
            where=path,
            todo="export XMP files (Export > Registration > XMP) beside the photographs, or COLMAP's format",
            topic="poses",
        )
    names, K, poses, bent = [], [], [], []
    for row in rows:
        value = {name: csv_number(row, name, path) for name in COLUMNS}
        focal = value["f"] * longer / _FILM_MM
        # From the image's centre, on the same 36 mm; width and height follow with the photograph.
        K.append([focal, focal, value["px"] * longer / _FILM_MM, value["py"] * longer / _FILM_MM])
        names.append(row["name"])
        poses.append(_pose(value))
        bent.append(_brown([value[k] for k in ("k1", "k2", "k3", "k4", "t1", "t2")], row["name"], path))
    notes = []
    if any(abs(k[2]) + abs(k[3]) > 0 for k in K):
        notes.append(
            "principal points of the CSV are taken as millimetres on 36 mm, as its focal lengths are"
        )
    sizes = [size] * len(names)
    centred = np.array(K) + np.array([0, 0, size[0] / 2, size[1] / 2])
    return Listed("RealityScan", names, centred, sizes, np.stack(poses), bent, "opengl", notes=notes)


def _pose(value: dict[str, float]) -> np.ndarray:
    """Camera to world, OpenGL axes: heading about z clockwise, then pitch about x, then roll about y."""
    yaw, pitch, roll = np.radians([-value["heading"], value["pitch"], value["roll"]])
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    pose = np.eye(4)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    pose[:3, :3] = about_z @ about_x @ about_y
    pose[:3, 3] = value["x"], value["y"], value["alt"]
    return pose


def _brown(k: Sequence[float], name: str, path: Path) -> Distortion | None:
    """Brown's model on x / z; k1 k2 k3 k4 t1 t2."""
    if k[3]:
        raise SceneError(
            f"{name} has a fourth radial term, which cannot be undistorted here",
            where=path,
            todo="align with the lens model Brown3 or without distortion, or export undistorted photographs",
            topic="lens",
        )
    bent = Distortion("FULL_OPENCV", (k[0], k[1], k[4], k[5], k[2], 0.0, 0.0, 0.0))
    return None if bent.absent else bent


def read_xmp(paths: Sequence[Path], photographs: Sequence[Photograph]) -> Listed:
    """The cameras of XMP files, each named as its photograph."""
    by_stem = {p.path.stem: p for p in photographs}
    names, K, sizes, poses, bent = [], [], [], [], []
    for path in paths:
        photograph = by_stem.get(path.stem)
        text = read_file(path).decode("utf-8", "replace")
        if photograph is None or _find(text, "Rotation") is None:
            continue
        size, longer = photograph.size, max(photograph.size)
        rotation = _values(text, "Rotation", 9, path).reshape(3, 3)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, _values(text, "Position", 3, path)
        focal = _values(text, "FocalLength35mm", 1, path)[0] * longer / _FILM_MM
        u, v = (float(_find(text, f"PrincipalPoint{k}") or 0) for k in "UV")
        model = _find(text, "DistortionModel") or "perspective"
        terms = _find(text, "DistortionCoeficients")
        k = [float(x) for x in terms.split()] if terms else [0.0] * 6
        if model.startswith("division") and any(k):
            raise SceneError(
                "the lens model is RealityScan's division, which cannot be undistorted here",
                where=path,
                todo="align with the lens model Brown3, or export undistorted photographs",
                topic="lens",
            )
        names.append(photograph.name)
        K.append([focal, focal, size[0] / 2 + u * longer, size[1] / 2 + v * longer])
        sizes.append(size)
        poses.append(pose)
        bent.append(_brown((k + [0.0] * 6)[:6], path.name, path))
    if not names:
        raise SceneError(
            "no XMP file here holds a camera's pose",
            where=paths[0].parent,
            cause="they are of a camera or an editor, or were exported without camera poses",
            todo="export them with the pose (Export > Registration > XMP), beside the photographs",
            topic="poses",
        )
    return Listed("RealityScan", names, np.array(K), sizes, np.stack(poses), bent)


def _find(text: str, name: str) -> str | None:
    found = re.search(rf'xcr:{name}(?:="([^"]*)"|>([^<]*)<)', text)
    return None if found is None else (found[1] if found[1] is not None else found[2])


def _values(text: str, name: str, count: int, path: Path) -> np.ndarray:
    try:
        values = np.array([float(x) for x in (_find(text, name) or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count:
        damaged(path, f"xcr:{name} is no {count} numbers")
    return values
