"""Photographs in a folder: which files they are, what their headers say of size, orientation and focal length."""

from __future__ import annotations

import hashlib
import math
import shlex
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.files.images import ENDINGS, decode_photograph, read_header
from datamodules.files.paths import read_file, stem
from datamodules.views.find_files import loose_key
from datamodules.views.mask_files import OTHER_FOLDERS
from visdom_plugin.compute.waiting import counting
from visdom_plugin.errors import SceneError, list_some

_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".3gp")
_RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
FULL_FRAME_MM = math.hypot(36, 24)
"""Diagonal of what focal lengths are compared on."""
_EXIF, _MAKE, _MODEL = 0x8769, 0x010F, 0x0110
_FOCAL, _FOCAL_35 = 0x920A, 0xA405
_MOST = 500


@dataclass(frozen=True)
class Photograph:
    """One file whose header has been read."""

    path: Path
    name: str
    """Below the folder, with forward slashes."""
    sha256: str
    size: tuple[int, int]
    """Width and height as stored."""
    orientation: int
    """EXIF's tag, 1 to 8."""
    camera: str
    """Make and model by EXIF; empty where it says nothing."""
    focal_mm: float | None
    """Focal length by EXIF, in millimetres of this very sensor: tells lenses and zooms apart."""
    focal_px: float | None
    """Focal length in pixels by EXIF's 35 mm equivalent: right within some per cent."""

    def decode(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB, as stored."""
        return decode_photograph(read_file(self.path), self.path)


def find_photographs(folder: Path) -> tuple[list[Photograph], list[str]]:
    """The photographs in a folder, by name, or in its subfolder `images`; and what is to be said of other files.

    Raises:
        SceneError: there is none, a file is damaged or of a format that needs an extra, or two have one name.
    """
    base, paths = _list(folder)
    others = [p.name for p in paths if p.suffix.lower() not in ENDINGS]
    videos = [n for n in others if n.lower().endswith(_VIDEOS)]
    raw = [n for n in others if n.lower().endswith(_RAW)]
    files = [p for p in paths if p.suffix.lower() in ENDINGS]
    if not files:
        cause, todo = "another folder is meant", "name the folder that the photographs are in"
        if videos:
            cause = f"it holds videos: {list_some(videos, 3)}"
            todo = (
                "take still photographs, or save some sharp frames as PNG: ffmpeg -i VIDEO -vf fps=1 %03d.png"
            )
        elif raw:
            cause, todo = (
                f"it holds raw photographs: {list_some(raw, 3)}",
                "develop them to JPEG, TIFF or PNG",
            )
        elif inner := _folders_of_photographs(base):
            cause = f"they lie in {'folders' if len(inner) > 1 else 'a folder'} below: " + list_some(
                f"{path.relative_to(base)} ({count})" for path, count in inner.items()
            )
            todo = f"name the one with the photographs: visdom-prepare {shlex.quote(str(next(iter(inner))))}"
        raise SceneError(
            "there are no photographs in this folder", where=base, cause=cause, todo=todo, topic="no-scene"
        )
    if len(files) > _MOST:
        raise SceneError(
            f"there are {len(files)} photographs; {_MOST} at most are read",
            where=base,
            cause="the frames of a video",
            todo="choose 6 to 50 of them, from different directions",
            topic="photograph",
        )
    _refuse_clashes(files, base)
    notes = [f"not read: {list_some(group)}, which {what}" for group, what in (
        (videos, "are videos"), (raw, "are raw photographs")) if group]  # fmt: skip
    with counting("reading what the files say", len(files)) as count:
        return [count(_read(path, base)) for path in files], notes


def _list(folder: Path) -> tuple[Path, list[Path]]:
    def files_of(base: Path) -> list[Path]:
        return sorted(p for p in base.iterdir() if p.is_file() and not p.name.startswith("."))

    paths, inner = files_of(folder), folder / "images"
    if inner.is_dir() and not any(p.suffix.lower() in ENDINGS for p in paths):
        return inner, files_of(inner)
    return folder, paths


def _folders_of_photographs(base: Path) -> dict[Path, int]:
    """Folders up to two levels below that hold images, with how many; most first, and masks last."""
    found: dict[Path, int] = {}
    for folder in (*base.glob("*"), *base.glob("*/*")):
        if folder.is_dir() and not folder.name.startswith("."):
            with suppress(OSError):
                count = sum(p.suffix.lower() in ENDINGS and p.is_file() for p in folder.iterdir())
                found |= {folder: count} if count else {}
    masks = ("masks", *OTHER_FOLDERS)
    return dict(sorted(found.items(), key=lambda x: (x[0].name.lower() in masks, -x[1], x[0])))


def _refuse_clashes(files: Sequence[Path], base: Path) -> None:
    by_name = defaultdict(list)
    for path in files:
        by_name[loose_key(stem(path.name) + ".png")].append(path.name)
    twice = [names for names in by_name.values() if len(names) > 1]
    if twice:
        raise SceneError(
            f"{len(twice)} names occur twice: {' and '.join(twice[0])}",
            where=base,
            cause="one photograph in two formats, as cameras save them, or masks beside the photographs",
            todo="keep one file of each; masks go to a folder masks",
            topic="photograph",
        )


def _read(path: Path, base: Path) -> Photograph:
    data = read_file(path)
    header = read_header(data, path)
    camera, focal_mm, focal_35 = _read_exif(data)
    focal_px = None
    if focal_35:
        focal_px = focal_35 / FULL_FRAME_MM * math.hypot(*header.size)
    digest = hashlib.sha256(data).hexdigest()
    name = path.relative_to(base).as_posix()
    return Photograph(path, name, digest, header.size, header.orientation, camera, focal_mm, focal_px)


def _read_exif(data: bytes) -> tuple[str, float | None, float | None]:
    """Make and model, focal length in millimetres, and its 35 mm equivalent; what is not there is empty."""
    import io

    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
    except Exception:  # Pillow raises whatever it comes across; the header itself has been checked
        return "", None, None
    words = (str(exif.get(tag, "")).strip("\0 ") for tag in (_MAKE, _MODEL))
    return " ".join(w for w in words if w), _positive(inner.get(_FOCAL)), _positive(inner.get(_FOCAL_35))


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def require_one_camera(photographs: Sequence[Photograph]) -> None:
    """Refuses photographs that one focal length cannot describe.

    Raises:
        SceneError: cameras, lenses, zooms or sizes differ.
    """
    groups: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for p in photographs:
        groups[(*sorted(p.size, reverse=True), p.camera, p.focal_mm and round(p.focal_mm, 2))].append(p.name)
    if len(groups) > 1:
        kinds = sorted(groups.items(), key=lambda item: -len(item[1]))
        said = "; ".join(
            f"{len(names)} of {key[0]} x {key[1]}"
            + (f" by {key[2]}" if key[2] else "")
            + (f" at {key[3]:g} mm" if key[3] else "")
            + f" ({list_some(names, 2)})"
            for key, names in kinds[:4]
        )
        raise SceneError(
            f"the photographs are of {len(groups)} cameras, lenses or sizes: {said}",
            where=photographs[0].path.parent,
            cause="two phones, another lens of the phone (0.5x, 2x), a crop or a zoom",
            todo="keep those of one camera at one zoom, as taken; the board calibrates them together",
            topic="several-lenses",
        )
