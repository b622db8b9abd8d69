"""Which mask file belongs to which photograph."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from datamodules.paths import inside, printable, stem
from datamodules.request import Request
from visdom_plugin.errors import SceneError

if TYPE_CHECKING:
    from datamodules.capture import Capture

log = logging.getLogger(__name__)

ENDINGS = (".png", ".jpg", ".jpeg")
_SHOWN = 5


def mask_names(photograph: str) -> tuple[str, ...]:
    """The names under which the mask of a photograph may lie in the mask folder, the usual one first."""
    starts = stem(photograph), photograph, f"{stem(photograph)}_mask"
    return tuple(start + end for start in starts for end in ENDINGS)


def assign_masks(capture: Capture, wanted: Sequence[int], request: Request) -> dict[int, str | None]:
    """The mask file of each wanted frame, below the root; None where the alpha channel must do.

    Raises:
        SceneError: wanted frames without a mask, or masks that look shifted against the photographs.
    """
    named = {i: capture.frames[i].mask for i in wanted}
    open_ones = [i for i in wanted if named[i] is None]
    folder = capture.mask_folder
    if not open_ones or folder is None:
        return named
    path = inside(capture.root, folder, outside=request.allow_outside)
    if request.mask_source == "alpha" or not path.is_dir():
        return named
    there = {file.relative_to(path).as_posix() for end in ENDINGS for file in path.rglob(f"*{end}")}
    below = [_below(capture, i) for i in range(len(capture.frames))]
    used: set[str] = set()
    found: dict[int, str] = {}
    for i, photograph in enumerate(below):
        files = [name for name in dict.fromkeys(mask_names(photograph)) if name in there]
        used.update(files)
        if len(files) > 1 and i in named:
            raise SceneError(
                f"{printable(photograph)} has more than one mask: {', '.join(map(printable, files))}",
                where=path,
                todo="keep the right one",
            )
        if files:
            found[i] = f"{folder}/{files[0]}"
    missing = [stem(below[i]) for i in open_ones if i not in found]
    without = sorted(stem(name) for i, name in enumerate(below) if i not in found)
    extra = sorted(printable(stem(name)) for name in there - used)
    shifted = _shifted(without, extra)
    if (missing and not request.allow_missing_masks) or shifted:
        missing = missing or without
        hint = f"there are masks that no image has: {some(extra)}" if extra else None
        raise SceneError(
            f"{len(missing)} of the images have no mask: {some(missing)}",
            where=path,
            cause=f"masks named otherwise, or shifted by one; {hint}" if hint else None,
            todo="name each mask like its image, with the ending .png; or say what becomes of views without: "
            "--data.missing-masks colour|hull",
        )
    if extra:
        log.info(
            "%s: %d masks belong to no registered image and are ignored: %s", path, len(extra), some(extra)
        )
    return {i: named[i] or found.get(i) for i in wanted}


def find_ignored(capture: Capture, index: int, request: Request) -> str | None:
    """The file in the folder `ignore`, white where a frame's photograph tells nothing, below the root."""
    for name in mask_names(_below(capture, index)):
        if inside(capture.root, f"ignore/{name}", outside=request.allow_outside).is_file():
            return f"ignore/{name}"
    return None


def some(names: Sequence[str]) -> str:
    """The first few of many names."""
    return ", ".join(names[:_SHOWN]) + (f", ... ({len(names)} in all)" if len(names) > _SHOWN else "")


def looks_inverted(mask: Tensor) -> bool:
    """Objects sit inside their photographs: a mask that holds the border but not the middle is inverted."""
    border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean()
    return bool(border > 0.8 and border > mask.float().mean())


def _below(capture: Capture, index: int) -> str:
    """The photograph's path below the folder of photographs."""
    image = capture.frames[index].image
    return image if capture.photographs is None else image.removeprefix(f"{capture.photographs}/")


def _shifted(without: list[str], extra: list[str]) -> bool:
    """Names that are the same numbers moved on, such as images 000..035 and masks 001..036."""

    def numbers(stems):
        digits = ["".join(c for c in name if c.isdigit()) for name in stems]
        return [int(d) for d in digits if d and len(d) < 40]

    a, b = numbers(without), numbers(extra)
    return bool(a) and len(a) == len(b) == len(extra) == len(without)
