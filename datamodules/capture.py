"""Types between a layout's reader and the scene: a capture with its frames, files of views, views read.

A layout's reader returns a `Capture`, whose pixels have not been read; `open_scene` makes a scene of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from datamodules.files.paths import stem
from datamodules.files.undistort import Distortion
from visdom_plugin.geometry.cameras import Cameras


@dataclass(frozen=True)
class Pools:
    """What a layout says of its own split."""

    train: tuple[int, ...]
    """Positions that training views may be taken from."""
    test: tuple[int, ...]
    rule: str
    """Where this split is from."""


@dataclass(frozen=True)
class Frame:
    """One photograph, not opened yet. Files are named below the capture's root, with forward slashes."""

    name: str
    """The view's name; unique but for its extension."""
    image: str
    mask: str | None = None
    """Foreground mask; None leaves it to the capture's mask folder, or to the image's alpha channel."""
    ignore: str | None = None
    """File whose black pixels are unknown (nerfstudio's meaning of a mask)."""
    excluded: str | None = None
    """File whose pixels that are not black are unknown (instant-ngp's dynamic masks); None looks for a file of
    the photograph's name in the folder `ignore`."""
    depth: str | None = None
    """Monocular depth, a 16-bit PNG of it times 1000 or .npy in any unit; need not exist."""


class Calibration(NamedTuple):
    """Cameras at the size they were calibrated for."""

    cameras: Cameras
    distortions: Sequence[Distortion | None]
    """One per camera; None is a pinhole."""


@dataclass(frozen=True)
class Capture:
    """A scene on disk whose calibration has been read and whose pixels have not."""

    root: Path
    layout: str
    frames: tuple[Frame, ...]
    """In the layout's order, which index files count in."""
    calibrate: Callable[[Sequence[int]], Calibration]
    """Cameras of some frames, by position; raises SceneError for what is wrong with these."""
    pools: Pools
    """The layout's own split."""
    calibration_files: tuple[str, ...]
    """Files below the root that frames, cameras and split were read from; need not exist."""
    indexed: bool = False
    """Whether index files must exist."""
    photographs: str | None = None
    """Folder of the photographs, of which there may be smaller copies in `<photographs>_<F>`."""
    mask_folder: str | None = None
    """Folder of masks named after the photographs; None where there is none."""
    points_file: str | None = None
    """COLMAP's file of triangulated points, below the root."""
    shrunk: float = 1.0
    """How much of the request's downscale the calibration has already (scale folders)."""
    units: str = "unknown"
    source: dict[str, Any] = field(default_factory=dict)
    """Plain data for run.json."""
    notes: tuple[str, ...] = ()
    """How the data was understood, one line each."""
    name: str | None = None
    """Of the scene; by default the root's."""
    honours: tuple[str, ...] = ()
    """Of `Request.OF_SOME`, the fields that make a difference to this capture."""


def sort_frames(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """In the order that index files count in: by name without extension."""
    return tuple(sorted(frames, key=lambda frame: stem(frame.name)))


class LoadedView(NamedTuple):
    """One view at its final size."""

    image: Tensor
    """(H, W, 3) uint8."""
    mask: Tensor
    """(H, W) bool, True on the object."""
    ignore: Tensor | None
    """(H, W) bool, True where nothing is known."""
    depth: Tensor | None
    """(H, W) float32."""
    masked: bool
    """False where the data has no mask for it; then `mask` is True everywhere."""
    soft: float = 0.0
    """Share of the mask's pixels that are neither black nor white."""
    grey: float = 0.0
    """Share of the mask's pixels that are not even nearly so; much of it, and it may be no mask."""
    remarks: tuple[str, ...] = ()
    """How its files were understood, where that is not plain."""


class InspectedView(NamedTuple):
    """What is known of a view whose photograph has not been decoded."""

    size: tuple[int, int]
    """Width and height it will have."""
    masked: bool
    ignoring: bool
    """Whether it may have ignored pixels."""
    deep: bool
    """Whether it has a depth map."""
    fingerprint: str
    """SHA-256 of its files and of all that decides what is made of them."""
