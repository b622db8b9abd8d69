"""Paths that the data names: no file outside the data folder is read because a data file says so."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from visdom_plugin.errors import SceneError


def check_name(relative: str, where: Path) -> None:
    """Refuses names in the data that are absolute, climb out of their folder, or hold control characters."""
    parts = relative.replace("\\", "/").split("/")
    drive = len(parts[0]) == 2 and parts[0].endswith(":")
    strange = not relative.isprintable() or not PurePosixPath(relative).name
    if strange or drive or parts[0] == "" or ".." in parts:
        raise SceneError(
            f"the data names a file outside its folder: {relative[:80]!r}",
            where=where,
            todo="name each image in the model by its path below the image folder",
        )


def inside(root: Path, relative: str) -> Path:
    """A path below `root` that really lies there.

    Raises:
        SceneError: the name leads out of the folder by itself or through a symbolic link.
    """
    check_name(relative, root)
    path = root / relative
    try:
        real, base = path.resolve(), root.resolve()
    except (OSError, RuntimeError) as error:
        raise SceneError(
            f"the path cannot be followed: {error}", where=path, todo="replace the links by files"
        ) from error
    if not real.is_relative_to(base):
        raise SceneError(
            "a symbolic link leads out of the scene's folder",
            where=f"{path} -> {real}",
            cause="files outside the data folder are never read",
            todo="copy the file into the folder, or link inside it only",
        )
    return path
