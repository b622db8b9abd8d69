"""Camera paths as JSON files: written by hand, by visdom-view, or by nerfstudio's viewer.

    {"camera_type": "perspective", "render_width": 1280, "render_height": 720, "fps": 30, "camera_path": [
        {"camera_to_world": [16 numbers, row by row; x right, y up, z back], "fov": 40},
        {"position": [1, 2, 3], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}]}

`fov` is the vertical angle of view in degrees. Only `camera_path` is needed. Poses are in the capture's own frame;
files of nerfstudio, in its own, are taken back by the dataparser_transforms.json beside them.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from visdom_plugin.atomic_files import write_json
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import capture_up, look_at_camera
from visdom_plugin.geometry.cameras import Cameras

NERFSTUDIO = "dataparser_transforms.json"
"""Nerfstudio writes it beside a run's config: the motion and the scale from the capture's frame to its own."""


class CameraPath(NamedTuple):
    """What a file says."""

    cameras: Cameras
    """(N,) cameras, float64."""
    fps: int | None
    """Frames per second, where it says them."""


def read_path(path: Path, capture: Cameras) -> CameraPath:
    """Reads a file; the module has its form.

    Args:
        capture: (M,) cameras of the capture; size and angle of view are the first one's, and up is theirs, where
            the file does not say.

    Raises:
        SceneError: it is missing, damaged, of another form, or in a frame that cannot be undone.
    """
    path = Path(path)
    content = _load(path)
    entries = content.get("camera_path")
    if not isinstance(entries, list) or not entries:
        raise SceneError(
            "the file holds no list camera_path with a camera for each frame",
            where=path,
            cause="a file of another kind: cameras of photographs are read as a scene, with --data",
        )
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise SceneError(f"camera_type is {kind!r}, and only perspective cameras are drawn", where=path)
    capture = capture.to("cpu", torch.float64)
    first = capture[0]
    width = _whole(content, "render_width", int(first.width), path)
    height = _whole(content, "render_height", int(first.height), path)
    own_fov = math.degrees(2 * math.atan(int(first.height) / 2 / float(first.intrinsics[1, 1])))
    up, intrinsics, poses = capture_up(capture), [], []
    for i, entry in enumerate(entries):
        where = f"{path}: camera_path[{i}]"
        if not isinstance(entry, dict):
            raise SceneError(
                "this is no camera", where=where, todo="write an object, see docs/guide/outputs.md"
            )
        fov = float(_numbers(entry, "fov", 1, where, torch.tensor([own_fov])))
        if not 0 < fov < 180:
            raise SceneError(f"fov is {fov:g}; it is the vertical angle of view in degrees", where=where)
        focal = height / 2 / math.tan(math.radians(fov) / 2)
        intrinsics.append([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        poses.append(_pose(entry, up, where))
    motion = torch.stack(poses)
    if "keyframes" in content and content.get("frame") != "capture":
        motion = _from_nerfstudio(motion, path)
    try:
        cameras = Cameras.from_matrices(torch.tensor(intrinsics), motion, width=width, height=height)
    except SceneError as error:
        raise SceneError(error.what, where=path, cause=error.cause, todo=error.todo) from error
    fps = content.get("fps")
    return CameraPath(
        cameras, None if fps is None else max(1, round(float(_numbers(content, "fps", 1, path))))
    )


def write_path(path: Path, cameras: Cameras, fps: int) -> None:
    """Writes cameras (N,) of one size, so that `read_path` and nerfstudio's form agree; in one step."""
    size = {"render_width": int(cameras.width[0]), "render_height": int(cameras.height[0])}
    flip = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    entries = []
    for i in range(len(cameras)):
        focal = float(cameras.intrinsics[i, 1, 1])
        motion = cameras.world_from_camera[i].double().cpu() * flip
        fov = math.degrees(2 * math.atan(size["render_height"] / 2 / focal))
        aspect = size["render_width"] / size["render_height"]
        entries.append({"camera_to_world": motion.reshape(-1).tolist(), "fov": fov, "aspect": aspect})
    kind = {"camera_type": "perspective", "frame": "capture"}
    write_json(path, kind | size | {"fps": fps, "seconds": len(cameras) / fps, "camera_path": entries})


def _load(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SceneError(f"the camera path cannot be read: {error}", where=path) from error
    if not isinstance(content, dict):
        raise SceneError("a camera path is a JSON object", where=path)
    return content


def _whole(content: dict[str, Any], name: str, default: int, path: Path) -> int:
    value = content.get(name, default)
    if not isinstance(value, (int, float)) or value != round(value) or value < 1:
        raise SceneError(f"{name} is {value!r}; it is a number of pixels", where=path)
    return int(value)


def _numbers(
    entry: dict[str, Any], name: str, count: int, where: object, default: Tensor | None = None
) -> Tensor:
    """(count,) float64 finite numbers of an entry."""
    if name not in entry and default is not None:
        return default.double()
    value = entry.get(name)
    try:
        found = torch.tensor(value, dtype=torch.float64).reshape(-1)
    except (TypeError, ValueError, RuntimeError):
        found = torch.tensor([])
    if len(found) != count or not bool(torch.isfinite(found).all()):
        wanted = "a number" if count == 1 else f"a list of {count} numbers"
        raise SceneError(f"{name} is {value!r}; it is {wanted}", where=where)
    return found


def _pose(entry: dict[str, Any], up: Tensor, where: str) -> Tensor:
    """(4, 4) world_from_camera of one entry, OpenCV axes."""
    if "camera_to_world" in entry:
        return _numbers(entry, "camera_to_world", 16, where).reshape(4, 4) * torch.tensor([1.0, -1, -1, 1])
    if "position" not in entry or "look_at" not in entry:
        raise SceneError(
            "a camera needs camera_to_world, or position and look_at",
            where=where,
            todo="see docs/guide/outputs.md",
        )
    position, target = (_numbers(entry, name, 3, where) for name in ("position", "look_at"))
    if bool((position == target).all()):
        raise SceneError("position and look_at are the same point", where=where)
    above = _numbers(entry, "up", 3, where, up)
    return look_at_camera(position, target, above)


def _from_nerfstudio(motion: Tensor, path: Path) -> Tensor:
    """Poses (N, 4, 4) of nerfstudio's frame, in the capture's."""
    beside = path.with_name(NERFSTUDIO)
    if not beside.is_file():
        raise SceneError(
            "this path is in nerfstudio's own frame, which is turned and scaled, and nothing says how",
            where=path,
            cause=f"it was written by nerfstudio's viewer, and {NERFSTUDIO} of the run is not beside it",
            todo=f"copy outputs/.../{NERFSTUDIO} beside it; or, where nerfstudio trained in the capture's frame, "
            'add "frame": "capture" to the file',
        )
    said = _load(beside)
    transform = _numbers(said, "transform", 12, beside).reshape(3, 4)
    scale = float(_numbers(said, "scale", 1, beside))
    if scale <= 0:
        raise SceneError(f"scale is {scale:g}", where=beside)
    turn = transform[:, :3]
    back = motion.clone()
    back[:, :3, :3] = turn.mT @ motion[:, :3, :3]
    back[:, :3, 3] = (motion[:, :3, 3] / scale - transform[:, 3]) @ turn
    return back
