"""Writing a prepared scene: built in a folder beside, renamed when it is whole, known again when it is there.

images/NAME.png   upright, without lens distortion    masks/NAME.png    white on the object
ignore/NAME.png   white where the lens showed nothing  transforms.json   cameras, as nerfstudio writes them
prepare.json      what was done                        prepare.png       photographs with outlines
"""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from visdom_plugin.atomic_files import MARK, write_json
from visdom_plugin.errors import ConfigError, list_some
from visdom_plugin.export.dataset import write_transforms
from visdom_plugin.figures.contact_sheet import write_png
from visdom_plugin.geometry.cameras import Cameras

_CAMERA_FILES = (".bin", ".txt", ".json", ".xml", ".csv", ".xmp", ".npz", ".npy")
_MOST_FILES = 5000
RECORD, SHEET = "prepare.json", "prepare.png"


def find_earlier(out: Path, asked: dict[str, Any], overwrite: bool) -> list[str] | None:
    """Whether the scene is there already.

    Args:
        asked: plain data that decides what is written.

    Returns:
        None where it has to be made; else the files changed since, usually none.

    Raises:
        ConfigError: the folder holds something else.
    """
    if not out.exists():
        return None
    record = read_record(out)
    if record is None:
        if out.is_dir() and not any(out.iterdir()):
            return None
        raise ConfigError(
            "there is a folder or file of this name, and it is no scene of visdom-prepare",
            where=f"--out {out}",
            todo="name a new folder",
            topic="other-run",
        )
    if overwrite:
        return None
    if record.get("asked") != asked:
        changes = list_some(_changes(record["asked"], asked), 4)
        raise ConfigError(
            f"this folder holds a scene made of other photographs or settings: {changes}",
            where=f"--out {out}",
            todo="name another folder, or pass --overwrite to make this one anew",
            topic="other-run",
        )
    written: dict[str, str] = record.get("written", {})
    return [n for n, digest in written.items() if not (out / n).is_file() or hash_file(out / n) != digest]


def _changes(before: Any, now: Any, name: str = "") -> list[str]:
    """What was asked for otherwise then, by name; of photographs and files, which."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        files = any(isinstance(v, str) and len(v) == 64 for v in (before, now))
        return [name if files else f"{name} was {before}, now {now}"] if before != now else []
    return [
        change
        for key in dict.fromkeys([*now, *before])
        for change in _changes(before.get(key), now.get(key), key)
    ]


def read_record(out: Path) -> dict[str, Any] | None:
    """The content of a scene's prepare.json; None where there is none."""
    try:
        found = json.loads((out / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and "asked" in found else None


def as_plain(value: Any) -> Any:
    """Settings as JSON gives them back: lists in place of tuples, no paths."""
    return json.loads(json.dumps(value, default=str))


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def hash_files(path: Path) -> dict[str, str]:
    """SHA-256 of a file, or of the files of cameras in a folder, by their name."""
    if path.is_file():
        return {path.name: hash_file(path)}
    files = sorted(p for p in path.rglob("*") if p.suffix.lower() in _CAMERA_FILES and p.is_file())
    return {p.relative_to(path).as_posix(): hash_file(p) for p in files[:_MOST_FILES]}


@contextmanager
def appearing_folder(out: Path) -> Iterator[Path]:
    """A new folder beside `out` that becomes `out` when the block succeeds, and is gone when it does not."""
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(f"{MARK}{secrets.token_hex(4)}-{out.name}")
    part.mkdir()
    old = out.with_name(f"{MARK}{secrets.token_hex(4)}-{out.name}")
    try:
        yield part
        if out.exists():
            out.replace(old)
        part.replace(out)
    finally:
        if old.exists() and not out.exists():
            old.replace(out)
        for folder in (part, old):
            if folder.exists():
                shutil.rmtree(folder)


def write_view(
    folder: Path, name: str, image: np.ndarray, mask: np.ndarray | None, ignore: np.ndarray | None
) -> None:
    """Writes one view's pictures.

    Args:
        name: without ending.
        image: (H, W, 3) uint8.
        mask, ignore: (H, W) bool or None.
    """
    write_png(folder / "images" / f"{name}.png", image)
    for kind, pixels in (("masks", mask), ("ignore", ignore)):
        if pixels is not None:
            write_png(folder / kind / f"{name}.png", np.where(pixels, 255, 0).astype(np.uint8))


def finish(folder: Path, cameras: Cameras, names: list[str], record: dict[str, Any]) -> None:
    """Writes the cameras and the record with the hashes of all that was written."""
    write_transforms(folder, [cameras[i] for i in range(len(cameras))], [f"{n}.png" for n in names])
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    written = {p.relative_to(folder).as_posix(): hash_file(p) for p in files}
    write_json(folder / RECORD, record | {"written": written})
