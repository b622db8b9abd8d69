"""Names in pose files against names on disk: another ending, case, folder or Unicode form."""

from __future__ import annotations

import logging
import os
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath

from datamodules.files.images import ENDINGS, is_image_name

log = logging.getLogger(__name__)

_MOST_FILES = 200_000
_NO_PHOTOGRAPHS = (
    "mask",
    "matt",
    "ignore",
    "depth",
    "normal",
    "segment",
    "silhouette",
    "alpha",
    "ground_truth",
)


def loose_key(name: str) -> str:
    """What names have in common that differ in case, in Unicode form and in an image's ending."""
    start, dot, ending = name.rpartition(".")
    name = start if dot and f".{ending.lower()}" in ENDINGS else name
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


class ImageFiles:
    """The image files below a folder, which is walked when the first name is not there as it is written."""

    def __init__(self, root: Path):
        self.root = root

    @cached_property
    def _by_key(self) -> dict[str, list[str]]:
        found, count = defaultdict(list), 0
        for folder, folders, files in os.walk(self.root):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            count += len(files)
            if count > _MOST_FILES:
                break
            for file in files:
                path = Path(folder, file).relative_to(self.root)
                if is_image_name(path):
                    found[loose_key(file)].append(path.as_posix())
        return found

    def find(self, name: str, *, anywhere: bool = True) -> str | None:
        """The one file that a name can mean, or the name itself where there is such a file; else None.

        The ending, the case, the Unicode form and leading folders may differ. Of several candidates, the one that
        shares most of the last folders counts, of several there the one with the name's own ending; folders of
        masks, depths and smaller copies hold no photographs unless the name says so.

        Args:
            anywhere: False looks in the folder alone that the name gives.
        """
        if (self.root / name).exists():
            return name
        wanted = _folders(name)
        shared = defaultdict(list)
        for file in self._by_key.get(loose_key(PurePosixPath(name).name), ()):
            folders = _folders(file)
            strange = [f for f in folders if any(word in f for word in _NO_PHOTOGRAPHS) or _is_smaller(f)]
            if folders == wanted or (anywhere and all(folder in wanted for folder in strange)):
                common = 0
                while common < min(len(folders), len(wanted)) and folders[-1 - common] == wanted[-1 - common]:
                    common += 1
                shared[common].append(file)
        best = shared[max(shared)] if shared else []
        # v01.JPG is nearer to v01.jpg than v01.png is, which may be a cut-out or a preview of it.
        ending = PurePosixPath(name).suffix.lower()
        if len(best) > 1:
            best = [file for file in best if PurePosixPath(file).suffix.lower() == ending]
        return best[0] if len(best) == 1 else None


def localise(there: ImageFiles, name: str) -> str:
    """The path below the folder of a file that the data names by a path of another folder or machine.

    Such a path is absolute, also on Windows, or climbs out. It stays where nothing below ends like it, and where
    it exists as it is.
    """
    parts = name.replace("\\", "/").split("/") if "\\" in name else name.split("/")
    drive = len(parts[0]) == 2 and parts[0].endswith(":")
    straight = os.path.normpath(name) if ".." in parts else name
    if straight[0] not in "./" and (there.root / straight).exists():
        return straight
    foreign = drive or parts[0] == "" or ".." in parts or "\\" in name
    if not foreign or not name.isprintable() or (there.root / name).exists():
        return name
    below = "/".join(part for part in parts[drive:] if part not in ("", ".", ".."))
    return (there.find(below) if below else None) or name


def note_localised(names: Sequence[str], found: Sequence[str]) -> list[str]:
    """The note on names that `localise` changed; none where it changed none."""
    changed = [(old, new) for old, new in zip(names, found, strict=True) if old != new]
    if not changed:
        return []
    old, new = changed[0]
    note = f"{len(changed)} of {len(names)} photographs are named by paths of another folder: {new} for {old}"
    log.warning("%s", note)
    return [note]


def _folders(name: str) -> list[str]:
    return [loose_key(part) for part in PurePosixPath(name).parts[:-1]]


def _is_smaller(folder: str) -> bool:
    return folder.startswith("images_") and folder.removeprefix("images_").isdecimal()
