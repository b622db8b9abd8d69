"""Photographs with cameras, before their pixels are read: what every source of poses returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datamodules.capture import Calibration, Capture, Frame, Pools
from datamodules.files.undistort import Distortion
from datamodules.open_scene import open_capture
from datamodules.request import Request
from visdom_plugin.compute.waiting import phase
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.scene import Scene


@dataclass(frozen=True)
class Placed:
    """The photographs that have a camera."""

    photographs: Sequence[Photograph]
    cameras: Cameras
    """(N,) float64, at the photographs' own sizes, as stored."""
    distortions: Sequence[Distortion | None]
    source: str
    """Where the poses are from, for people."""
    units: str = "unknown"
    on_board: bool = False
    """Whether the world is the board's, the object above it."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Photographs without a camera, and why."""
    views: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Plain data on single views, for prepare.json."""
    details: dict[str, Any] = field(default_factory=dict)
    """Plain data on all of them."""
    notes: Sequence[str] = ()


@phase("reading the photographs")
def read_placed(placed: Placed, root: Path, *, size: int, masks: str | None, look: bool) -> Scene:
    """Photographs without lens distortion and the masks that are there, as training views of a scene.

    Args:
        root: folder of photographs and masks.
        size: longest side in pixels at most; 0 keeps the size.
        masks: folder of masks; None looks for one of a usual name.
        look: False looks for no masks at all.
    """
    photographs, base = placed.photographs, placed.photographs[0].path.parent
    folder = base.relative_to(root).as_posix() if base != root else None
    prefix = "" if folder is None else f"{folder}/"
    frames = tuple(Frame(p.name, prefix + p.name) for p in photographs)
    longest = max(max(p.size) for p in photographs)
    capture = Capture(
        root,
        "prepare",
        frames,
        lambda wanted: Calibration(placed.cameras[list(wanted)], [placed.distortions[i] for i in wanted]),
        Pools(tuple(range(len(frames))), (), "all photographs"),
        (),
        photographs=folder,
        mask_folder="masks" if look else None,
        units=placed.units,
    )
    return open_capture(
        capture,
        Request(
            views=len(frames),
            downscale=max(1.0, longest / size) if size else 1.0,
            train_list="all",
            test=False,
            masks=masks if look else None,
            mask_source="auto" if look else "folder",
            allow_missing_masks=True,
            allow_outside=True,
        ),
    )


def turn_upright(cameras: Cameras, orientations: Sequence[int]) -> Cameras:
    """The cameras of photographs turned by EXIF's tags; mirrored ones (2, 4, 5, 7) cannot be had by turning.

    Args:
        cameras: (N,) of the photographs as stored.
        orientations: N tags, 1, 3, 6 or 8.
    """
    turned = []
    for i, tag in enumerate(orientations):
        camera = cameras[i]
        width, height = (int(x) for x in (camera.width, camera.height))
        # New pixel coordinates of the old ones, as one affine map of the plane.
        map_ = {
            3: [[-1, 0, width], [0, -1, height], [0, 0, 1]],
            6: [[0, -1, height], [1, 0, 0], [0, 0, 1]],
            8: [[0, 1, 0], [-1, 0, width], [0, 0, 1]],
        }.get(tag)
        if map_ is None:
            turned.append(camera)
            continue
        move = torch.tensor(map_, dtype=torch.float64)
        roll = torch.eye(4, dtype=torch.float64)
        roll[:2, :2] = move[:2, :2]
        # K' (R v) = move (K v) for all v: R turns about the camera's axis.
        K = move @ camera.intrinsics @ roll[:3, :3].mT
        size = (width, height) if tag == 3 else (height, width)
        turned.append(
            Cameras(
                K, camera.world_from_camera @ roll.mT, *(torch.tensor(s, dtype=torch.int64) for s in size)
            )
        )
    return Cameras.stack(turned)


def make_cameras(
    K: np.ndarray, world_from_camera: Sequence[np.ndarray], sizes: Sequence[tuple[int, int]]
) -> Cameras:
    """(N,) float64 cameras from arrays: intrinsics (N, 3, 3), poses N x (4, 4) with OpenCV axes."""
    width, height = torch.tensor(list(sizes), dtype=torch.int64).unbind(1)
    motions = torch.from_numpy(np.stack(world_from_camera).astype(np.float64))
    return Cameras.from_matrices(
        torch.from_numpy(np.asarray(K, np.float64)), motions, width=width, height=height
    )
