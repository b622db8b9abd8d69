"""Paths that the data names: no file outside the data folder is read because a data file says so.

Files are opened without waiting and only when they are plain files: a pipe or a device in a scene's place
would otherwise hang the reader or never end.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path, PurePosixPath

from visdom_plugin.errors import SceneError

MOST_BYTES = 2**31
"""No single file of a scene is larger; its bytes are held in memory while it is read."""
_LONGEST_NAME, _LONGEST_PATH = 220, 3000
"""File systems stop at 255 bytes and 4096; the rest is for the endings of masks and side files."""
_POINTER = b"version https://git-lfs.github.com/spec/"
_OPTION = "pass --allow-outside if you trust this data"


def check_name(relative: str, where: Path, *, outside: bool = False) -> None:
    """Refuses names in the data that are absolute, climb out of their folder, or hold control characters.

    Args:
        outside: let absolute names and names that climb pass, as --allow-outside does.
    """
    parts = relative.replace("\\", "/").split("/")
    drive = len(parts[0]) == 2 and parts[0].endswith(":")
    fine = relative.isprintable() and len(relative) < _LONGEST_PATH and bool(PurePosixPath(relative).name)
    if not fine or max(len(part.encode()) for part in parts) > _LONGEST_NAME:
        raise SceneError(
            f"the data names a file in a way that no file is named: {_shown(relative)}",
            where=where,
            cause="a damaged file, or a name that is endless or not UTF-8",
            todo="rename the file, or correct its name in the data",
        )
    if not outside and (drive or parts[0] == "" or ".." in parts):
        raise SceneError(
            f"the data names a file outside its folder: {_shown(relative)}",
            where=where,
            todo=f"name each image by its path below the scene's folder, or {_OPTION}",
            topic="outside-path",
        )


def inside(root: Path, relative: str, *, outside: bool = False) -> Path:
    """A path below `root` that really lies there.

    Args:
        relative: with forward slashes.
        outside: anywhere will do.

    Raises:
        SceneError: the name leads out of the folder by itself or through a symbolic link.
    """
    check_name(relative, root, outside=outside)
    path = root / relative
    if outside:
        return path
    try:
        real, base = path.resolve(), root.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise SceneError(
            f"the path cannot be followed: {error}", where=path, todo="replace the links by files"
        ) from error
    if not real.is_relative_to(base):
        raise SceneError(
            "a symbolic link leads out of the scene's folder",
            where=f"{path} -> {real}",
            cause="files outside the data folder are never read",
            todo=f"copy the file into the folder, or {_OPTION}",
            topic="outside-path",
        )
    return path


def read_plain(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a plain file of at most `most` bytes.

    Raises:
        OSError: it is missing, may not be read, is not a plain file, or is larger.
        SceneError: it stands for a file that was not fetched.
    """
    # Opening a pipe would wait for its writer.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(0, "it is not a plain file")
        if status.st_size > most:
            raise OSError(0, f"it has {status.st_size} bytes; at most {most} are read")
        with open(handle, "rb", closefd=False) as file:
            data = file.read(status.st_size)
    finally:
        os.close(handle)
    if data.startswith(_POINTER):
        raise SceneError(
            f"{printable(path.name)} is a pointer of Git LFS, not the file itself",
            where=path,
            cause="a repository cloned without Git LFS, or downloaded as an archive",
            todo="git lfs install && git lfs pull, in the repository",
            topic="missing-file",
        )
    return data


def read_file(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a plain file.

    Raises:
        SceneError: it is missing, cannot be read or is too large.
    """
    try:
        return read_plain(path, most)
    except FileNotFoundError:
        raise SceneError(
            f"there is no file {printable(path.name)}",
            where=path,
            cause="the scene was copied only in part",
            todo="copy it there",
            topic="missing-file",
        ) from None
    except (OSError, ValueError) as error:
        raise SceneError(
            f"{printable(path.name)} cannot be read: {getattr(error, 'strerror', None) or error}",
            where=path,
            todo="make it a plain file that you may read",
        ) from error


def read_inside(root: Path, relative: str, *, outside: bool = False, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file below `root`.

    Raises:
        SceneError: it leads outside, is missing, cannot be read or is too large.
    """
    return read_file(inside(root, relative, outside=outside), most)


def stem(name: str) -> str:
    """A view's name without its extension, by which views are sorted and their masks found."""
    return str(PurePosixPath(name).with_suffix(""))


def printable(name: str) -> str:
    """A file name that can be written anywhere, for messages and records: no broken UTF-8."""
    return name.encode("utf-8", "replace").decode("utf-8")


def _shown(relative: str) -> str:
    return ascii(relative[:80])[1:-1] if not relative.isprintable() else relative[:80]
