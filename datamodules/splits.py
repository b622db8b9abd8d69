"""Index files: which registered images train and which test."""

from __future__ import annotations

import hashlib
from pathlib import Path

from datamodules.paths import inside
from visdom_plugin.errors import SceneError


def read_splits(
    root: Path, views: int | None, registered: int, *, test: bool = True
) -> tuple[list[int], list[int], dict[str, str]]:
    """Positions of the training and test views in the name-sorted list of registered images.

    Args:
        root: the scene's folder, with sparse_<N>.txt and sparse_test.txt.
        views: N, or None for the smallest there is.
        registered: number of registered images.
        test: False ignores sparse_test.txt.

    Returns:
        train positions and test positions in the files' order, and the SHA-256 of each file read by its name.

    Raises:
        SceneError: a file is missing, is not integers, is out of range, repeats itself, has another length
            than its name says, or shares a view with the other.
    """
    available = sorted(
        int(path.stem.removeprefix("sparse_"))
        for path in root.glob("sparse_*.txt")
        if path.stem.removeprefix("sparse_").isdecimal()
    )
    if views is None and available:
        views = available[0]
    if views not in available:
        listed = ", ".join(map(str, available))
        raise SceneError(
            f"there is no sparse_{'<N>' if views is None else views}.txt"
            + (f"; this scene has index files for {listed} views" if available else ""),
            where=root,
            todo=f"pass --views with one of {listed}"
            if available
            else "write the zero-based positions of the training views, one per line, into sparse_<N>.txt",
        )
    train_path, test_path = root / f"sparse_{views}.txt", root / "sparse_test.txt"
    train, train_hash = _read(train_path, registered)
    if len(train) != views:
        raise SceneError(
            f"{train_path.name} lists {len(train)} views, its name says {views}",
            where=train_path,
            todo="rename the file or correct the list",
        )
    if not test:
        return train, [], {train_path.name: train_hash}
    if not test_path.is_file():
        raise SceneError(
            "sparse_test.txt is missing",
            where=root,
            todo="write the zero-based positions of the views to test on into it, one per line",
        )
    tested, test_hash = _read(test_path, registered)
    shared = sorted(set(train) & set(tested))
    if shared:
        raise SceneError(
            f"training and test share views {', '.join(map(str, shared[:8]))}",
            where=f"{train_path} and {test_path.name}",
            cause="a test on views that were trained on measures nothing",
            todo=f"take them out of {test_path.name}",
        )
    return train, tested, {train_path.name: train_hash, test_path.name: test_hash}


def _read(path: Path, registered: int) -> tuple[list[int], str]:
    try:
        data = inside(path.parent, path.name).read_bytes()
    except OSError as error:
        raise SceneError(
            f"the index file cannot be read: {error.strerror}", where=path, todo="make it a plain text file"
        ) from error
    words = data.decode("utf-8", errors="replace").split()
    for word in words:
        if not (word.isascii() and word.lstrip("-").isdecimal() and len(word) < 12):
            raise SceneError(
                f"{path.name} holds {word[:40]!r}, which is not an integer",
                where=path,
                todo="write zero-based positions in the name-sorted list of images, not file names",
            )
    positions = [int(word) for word in words]
    if not positions:
        raise SceneError(f"{path.name} lists no views", where=path, todo="write one position per line")
    outside = [p for p in positions if not 0 <= p < registered]
    if outside:
        raise SceneError(
            f"{path.name} lists position {outside[0]}, but the {registered} registered images have 0 to "
            f"{registered - 1}",
            where=path,
            cause="positions counted from 1, or a list made for another model" if outside[0] >= 0 else None,
            todo="write zero-based positions in the name-sorted list of registered images",
        )
    twice = sorted({p for p in positions if positions.count(p) > 1})
    if twice:
        raise SceneError(
            f"{path.name} lists position {twice[0]} twice", where=path, todo="list each view once"
        )
    return positions, hashlib.sha256(data).hexdigest()
