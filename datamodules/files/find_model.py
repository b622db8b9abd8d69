"""COLMAP models below a scene's folder: where they lie, how many photographs each has, and which one is read."""

from __future__ import annotations

import struct
from pathlib import Path

from datamodules.files.paths import printable, read_plain
from visdom_plugin.errors import SceneError

FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_PLACES = ("sparse", "colmap/sparse", "colmap_sparse", "dense/sparse", "distorted/sparse", "")
"""Folders that hold a model, or one model per numbered folder; what comes first is preferred."""


def find_model(root: Path) -> str | None:
    """The first folder below `root`, "" for itself, that holds a model's cameras and images files."""
    return next(iter(list_models(root)), None)


def list_models(root: Path) -> list[str]:
    """All folders below `root` that hold a model, in order of preference: of several in one place by number.

    InstantSplat's sparse_<N>/0 are the last ones before the root itself.
    """
    splats = sorted((path.name for path in root.glob("sparse_*") if path.is_dir()), key=_by_number)
    found = []
    for place in (*_PLACES[:-1], *splats, ""):
        start = f"{place}/" if place else ""
        numbered = sorted((p.name for p in (root / place).glob("*") if p.name.isdecimal()), key=_by_number)
        found += [f"{start}{name}" for name in (numbered if place else ())] + [place]
    return [folder for folder in found if any((root / folder / name).exists() for name in FILES)]


def choose_model(root: Path, asked: str | None) -> tuple[str | None, list[str]]:
    """The model to read and what is to be said of the choice: the one that is asked for, or of those in the
    preferred place the one with most photographs.

    Raises:
        SceneError: there is no such model.
    """
    there = list_models(root)
    if asked is not None:
        asked = "" if asked in (".", "./") else asked.strip("/")
        if asked not in there:
            raise SceneError(
                f"there is no COLMAP model in {printable(asked) or 'the folder itself'}",
                where=root,
                todo=f"--colmap-model with one of {', '.join(there)}"
                if there
                else "put cameras and images there",
                topic="no-scene",
            )
        return asked.strip("/"), []
    if len(there) < 2:
        return next(iter(there), None), []
    counts = {folder: _count_images(root / folder) for folder in there}
    place = _place(there[0])
    chosen = max((folder for folder in there if _place(folder) == place), key=lambda folder: counts[folder])
    others = [folder for folder in there if folder != chosen]
    listed = [f"{folder or 'the folder itself'} with {counts[folder]}" for folder in others]
    return chosen, [
        f"{len(there)} COLMAP models: {chosen} with {counts[chosen]} photographs is read, not {', '.join(listed)} "
        f"(--colmap-model {others[0] or '.'} reads another)"
    ]


def _place(folder: str) -> str:
    """Where a model lies; models of InstantSplat, sparse_<N>/0, are in one place."""
    start, _, last = folder.rpartition("/")
    start = start if last.isdecimal() else folder
    return "sparse_<N>" if start.startswith("sparse_") else start


def _by_number(name: str) -> tuple[int, str]:
    digits = "".join(c for c in name if c in "0123456789")[:9]
    return int(digits or 0), name


def _count_images(folder: Path) -> int:
    """How many photographs a model says it has; 0 for a file that cannot be read, which is told when it is."""
    try:
        if (folder / "images.bin").exists():
            return int(struct.unpack("<Q", read_plain(folder / "images.bin")[:8])[0])
        lines = read_plain(folder / "images.txt").decode("utf-8", "replace").splitlines()
        # Two lines per image, the second of which (its 2D points) may be empty.
        return (sum(not line.startswith("#") for line in lines) + 1) // 2
    except (OSError, struct.error):
        return 0
