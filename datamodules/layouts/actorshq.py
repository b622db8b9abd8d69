"""ActorsHQ as HumanRF publishes it: one frame of a sequence filmed by 160 cameras.

<sequence>/{1x,2x,4x}/calibration.csv      name, w, h, rx, ry, rz, tx, ty, tz, fx, fy, px, py; a row per camera
                      rgbs/Cam001/Cam001_rgb000015.jpg, masks/Cam001/Cam001_mask000015.png
<sequence>/aabbs.csv                       box of the actor in each frame, metres

(rx, ry, rz) is the axis times the angle in radians of the camera-to-world rotation, (tx, ty, tz) the centre in
metres, axes x right, y down, z forward. fx, px are fractions of the width, fy, py of the height: the principal
point is off centre and is kept. Cameras stand upright or lie on their side. Positions in lists are rows of the
table, counted from 0 (Cam001 is 0). --downscale 1, 2, 4 and more take the folder of that scale.

30 of the 160 cameras, evenly spread, are held out for testing, fewer of fewer in proportion. Training cameras are
spread evenly over the others, or listed. The paper's cameras and frame are those of --split visdom.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from datamodules.capture import Calibration, Capture, Frame, Pools
from datamodules.files.parsers import csv_number, damaged, parse_csv, size
from datamodules.files.paths import check_name, inside, read_inside
from datamodules.files.pinholes import pinholes
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.named_splits import FRAMES
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion

log = logging.getLogger(__name__)

_SCALES = (1, 2, 4)
_COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
_CORNERS = tuple(f"aabb_{end}_{axis}" for end in ("min", "max") for axis in "xyz")
_HELD_OUT, _ALL = 30, 160


def recognise(root: Path) -> str | None:
    """calibration.csv, here or in a folder of a scale, or None."""
    for folder in ("", *(f"{s}x/" for s in _SCALES)):
        if (root / f"{folder}calibration.csv").exists():
            return f"{folder}calibration.csv"
    return None


def read(root: Path, request: Request) -> Capture:
    """Reads one frame's cameras at the scale that the downscale asks for.

    Raises:
        SceneError: the scale or the frame is not there, or the table is damaged.
    """
    scale, folder = _choose_scale(root, request)
    path = root / f"{folder}calibration.csv"
    data = read_inside(root, f"{folder}calibration.csv", outside=request.allow_outside, most=2**24)
    cameras = parse_calibration(data, path)
    frame = _choose_frame(root, folder, cameras, request)
    frames, there = [], []
    for row, camera in enumerate(cameras):
        name = camera["name"]
        image = f"{folder}rgbs/{name}/{name}_rgb{frame:06d}.jpg"
        frames.append(Frame(name, image, mask=f"{folder}masks/{name}/{name}_mask{frame:06d}.png"))
        if (root / image).exists():
            there.append(row)
    notes = []
    if len(there) < len(cameras):
        notes.append(
            f"{len(cameras) - len(there)} of {len(cameras)} cameras have no photograph of frame {frame}"
        )
        log.warning("%s: %s", root, notes[0])
    source = {"frame_number": frame, "scale": scale}
    box = read_box(root, frame, request)
    if box is not None:
        source["aabb"] = box.tolist()

    def calibrate(wanted: Sequence[int]) -> Calibration:
        found = cameras_of([cameras[i] for i in wanted], path)
        return Calibration(found, [None] * len(found))

    return Capture(
        root,
        "actorshq",
        tuple(frames),
        calibrate,
        hold_out(there),
        (f"{folder}calibration.csv", "aabbs.csv"),
        shrunk=scale,
        units="metres",
        source=source,
        honours=("frame",),
        notes=tuple(notes),
    )


def hold_out(rows: Sequence[int]) -> Pools:
    """30 of 160 cameras for testing, evenly spread, in proportion for fewer; the others may train."""
    count = min(round(len(rows) * _HELD_OUT / _ALL), _HELD_OUT)
    test = splits.pick_evenly(rows, count) if count else []
    rule = f"{count} of {len(rows)} cameras held out, evenly spread"
    return Pools(tuple(i for i in rows if i not in set(test)), tuple(test), rule)


def parse_calibration(data: bytes, path: Path) -> list[dict]:
    """Rows with the camera's name, `w` and `h` as int and the other columns as finite float.

    Raises:
        SceneError: a column is missing, a value is no finite number, or a name is given twice.
    """
    rows, names = [], set()
    for raw in parse_csv(data, path, _COLUMNS):
        row = {column: csv_number(raw, column, path) for column in _COLUMNS[1:]}
        row |= {column: size(row[column], column, path) for column in ("w", "h")}
        name = raw["name"]
        check_name(name, path)
        if name in names or "/" in name or "\\" in name:
            damaged(path, f"the camera name {name[:40]!r} is {'given twice' if name in names else 'a path'}")
        names.add(name)
        rows.append({"name": name, **row})
    if not rows:
        damaged(path, f"{path.name} lists no cameras")
    return rows


def read_box(root: Path, frame: int, request: Request) -> np.ndarray | None:
    """(2, 3) lower and upper corner of the actor in a frame, metres; None where aabbs.csv does not say."""
    path = inside(root, "aabbs.csv", outside=request.allow_outside)
    if not path.is_file():
        return None
    data = read_inside(root, "aabbs.csv", outside=request.allow_outside, most=2**24)
    return parse_boxes(data, path).get(frame)


def parse_boxes(data: bytes, path: Path) -> dict[int, np.ndarray]:
    """(2, 3) corners by frame number."""
    boxes = {}
    for row in parse_csv(data, path, ("frame_number", *_CORNERS)):
        frame = csv_number(row, "frame_number", path)
        box = np.array([csv_number(row, column, path) for column in _CORNERS]).reshape(2, 3)
        if (box[0] > box[1]).any() or frame != round(frame):
            damaged(path, f"the box of frame {frame:g} is {box.tolist()}")
        boxes[int(frame)] = box
    return boxes


def cameras_of(rows: Sequence[dict], path: Path) -> Cameras:
    """Cameras of some rows of calibration.csv."""
    axis = np.array([[row[c] for c in ("rx", "ry", "rz")] for row in rows]).reshape(-1, 3)
    angle = np.linalg.norm(axis, axis=1, keepdims=True)
    if angle.size and not angle.max() < 1e3:
        damaged(path, "a rotation of more than 1000 radians")
    # sin(a / 2) / a, whose limit at 0 is 1/2.
    part = np.sinc(angle / (2 * math.pi)) / 2
    rotation = matrix_from_quaternion(torch.from_numpy(np.concatenate([np.cos(angle / 2), axis * part], -1)))
    centre = np.array([[row[c] for c in ("tx", "ty", "tz")] for row in rows]).reshape(-1, 3, 1)
    sizes = [(row["w"], row["h"]) for row in rows]
    K = [[w * r["fx"], h * r["fy"], w * r["px"], h * r["py"]] for r, (w, h) in zip(rows, sizes, strict=True)]
    motion = np.concatenate([rotation.numpy(), centre], -1)
    return pinholes(K, motion, sizes, names=[row["name"] for row in rows], where=path)


def _choose_scale(root: Path, request: Request) -> tuple[int, str]:
    """The scale and its folder with a slash, "" for the root itself."""
    if (root / "calibration.csv").exists():
        return 1, ""
    there = [s for s in _SCALES if (root / f"{s}x/calibration.csv").exists()]
    fitting = [s for s in there if s <= request.downscale]
    if not fitting:
        raise SceneError(
            f"this sequence has images at {', '.join(f'1/{s}' for s in there) or 'no scale'} only",
            where=root,
            todo=f"pass --downscale {there[0]}" if there else "put calibration.csv, rgbs and masks into 4x/",
        )
    return fitting[-1], f"{fitting[-1]}x/"


def _choose_frame(root: Path, folder: str, cameras: list[dict], request: Request) -> int:
    """The frame asked for, the split's, or the first that the first camera with photographs has."""
    wanted = request.frame
    if wanted is None and request.split is not None:
        wanted = FRAMES.get(request.split.partition(":")[0])
    for camera in cameras:
        name = camera["name"]
        place = inside(root, f"{folder}rgbs/{name}", outside=request.allow_outside)
        if not place.is_dir():
            continue
        pattern = re.compile(re.escape(name) + r"_rgb(\d{6})\.jpg")
        found = sorted(int(m[1]) for m in map(pattern.fullmatch, (p.name for p in place.iterdir())) if m)
        if found and wanted is None:
            return found[0]
        if wanted in found:
            return wanted
        if found:
            raise SceneError(
                f"there is no frame {wanted}; {name} has {len(found)} from {found[0]} to {found[-1]}",
                where=place,
                todo="pass another --frame",
            )
    raise SceneError(
        "there are no photographs of any camera",
        where=root / folder / "rgbs",
        cause="the scene was copied only in part",
        todo="they are expected as rgbs/Cam001/Cam001_rgb000000.jpg",
        topic="no-scene",
    )
