"""Which files of a folder a request reads, and a hash of these: whether a scene is still the same.

Nothing else in the folder counts, so results may be written into it. No picture is decoded.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any, NamedTuple

from datamodules.capture import Capture
from datamodules.files.paths import inside, read_file
from datamodules.open_scene import Chosen, choose_files
from datamodules.recognise import opening, read_capture
from datamodules.request import Request
from datamodules.views.reader import map_on_cores


class Fingerprint(NamedTuple):
    """What `take_fingerprint` finds out about a scene."""

    digest: str
    """SHA-256 of the views chosen and of every byte of the files that `datamodules.load` reads."""
    train: int
    """Number of training views."""
    frame: int | None
    """Of a video layout: the frame."""


def take_fingerprint(
    path: str | Path,
    *,
    known: MutableMapping[Path, str] | None = None,
    data_format: str | None = None,
    **reading: Any,
) -> Fingerprint:
    """The fingerprint of a scene on disk.

    It tells neither where the folder lies nor how pixels are made of the files (`downscale`, `mask_source`).

    Args:
        known: hashes of files, which the caller keeps between calls while no file changes.
        data_format: as for `datamodules.load`.
        reading: fields of `request.Request`.

    Raises:
        SceneError: for faults of the folder, the calibration and the choice of views; faults of pictures are
            left to whoever decodes them.
        ConfigError: for an option out of range, and a list given by hand that does not fit the data.
    """
    request = Request(**reading)
    known = {} if known is None else known
    with opening(path) as root:
        capture = read_capture(root, data_format, request)
        chosen = choose_files(capture, request)
        names = list(dict.fromkeys(list_files(capture, chosen)))
        paths = [inside(capture.root, name, outside=request.allow_outside) for name in names]
        new = [p for p in dict.fromkeys(paths) if p not in known]
        known.update(zip(new, map_on_cores(lambda i: hash_file(new[i]), range(len(new))), strict=True))
    split = chosen.split
    content = {
        "layout": capture.layout,
        "frames": [frame.name for frame in capture.frames],
        "train": split.train,
        "test": split.test,
        "lists": split.hashes,
        "files": [(name, known[p]) for name, p in zip(names, paths, strict=True)],
    }
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return Fingerprint(digest, len(split.train), capture.source.get("frame_number"))


def list_files(capture: Capture, chosen: Chosen) -> Iterator[str]:
    """All files that are read for the chosen views, below the capture's root; some need not exist."""
    yield from capture.calibration_files
    for view in chosen.files:
        yield view.image
        yield from (f for f in (view.mask, view.ignore, view.excluded, view.depth) if f is not None)


def hash_file(path: Path) -> str:
    """SHA-256 of a plain file's bytes; "" where there is none.

    Raises:
        SceneError: it cannot be read.
    """
    return hashlib.sha256(read_file(path)).hexdigest() if path.exists() else ""
