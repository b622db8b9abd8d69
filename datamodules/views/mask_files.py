"""Which mask file belongs to which photograph."""

from __future__ import annotations

import logging
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath

import torch
from torch import Tensor

from datamodules.capture import Capture
from datamodules.files.paths import inside, printable, stem
from datamodules.request import Request
from visdom_plugin.errors import SceneError, list_some

log = logging.getLogger(__name__)

ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


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
    there = {file.relative_to(path).as_posix() for file in path.rglob("*") if file.suffix in ENDINGS}
    photographs = _photographs(capture)
    used: set[str] = set()
    found: dict[int, str] = {}
    for i, names in enumerate(photographs):
        # The photograph's folders may be repeated among the masks, or left out where that is unambiguous.
        files = next(filter(None, ([m for m in mask_names(n) if m in there] for n in names)), [])
        used.update(files)
        if len(files) > 1 and i in named:
            raise SceneError(
                f"{printable(names[0])} has more than one mask: {', '.join(map(printable, files))}",
                where=path,
                todo="keep the right one",
            )
        if files:
            found[i] = f"{folder}/{files[0]}"
    missing = [i for i in open_ones if i not in found]
    extra = sorted(printable(stem(name)) for name in there - used)
    shift = _find_shift((name for names in photographs for name in names), there)
    if (missing or shift) and not request.allow_missing_masks:
        missing = missing or [i for i in range(len(photographs)) if i not in found]
        hint = f"there are masks that no image has: {list_some(extra)}" if extra else None
        reason = f"the masks' numbers are shifted by {shift}" if shift else "masks named otherwise"
        looked = " or ".join(f"{folder}/{printable(stem(name))}.png" for name in photographs[missing[0]])
        raise SceneError(
            f"{len(missing)} of the images have no mask: {list_some([stem(photographs[i][0]) for i in missing])}",
            where=path,
            cause=f"{reason}; {hint}" if hint else None,
            todo=f"name each mask like its image, such as {looked}; or say what becomes of views without: "
            "--data.missing-masks colour|hull",
        )
    if shift:
        log.warning("%s: the masks look shifted by %d against the photographs' numbers", path, shift)
    if extra:
        log.info(
            "%s: %d masks belong to no registered image and are ignored: %s",
            path,
            len(extra),
            list_some(extra),
        )
    return {i: named[i] or found.get(i) for i in wanted}


def find_ignored(capture: Capture, wanted: Sequence[int], request: Request) -> dict[int, str]:
    """The files in the folder `ignore`, white where a frame's photograph tells nothing, below the root."""
    found: dict[int, str] = {}
    if not (capture.root / "ignore").is_dir():
        return found
    photographs = _photographs(capture)
    for i in wanted:
        files = (f"ignore/{file}" for name in photographs[i] for file in mask_names(name))
        for file in files:
            if inside(capture.root, file, outside=request.allow_outside).is_file():
                found[i] = file
                break
    return found


def looks_inverted(mask: Tensor) -> bool:
    """Objects sit inside their photographs: a mask that holds the border but not the middle is inverted."""
    border = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).float().mean()
    return bool(border > 0.8 and border > mask.float().mean())


def _photographs(capture: Capture) -> list[tuple[str, ...]]:
    """Each photograph's path below the folder of photographs, and its bare name where that is another and no
    other photograph's."""
    start = "" if capture.photographs is None else f"{capture.photographs}/"
    below = [frame.image.removeprefix(start) for frame in capture.frames]
    bare = [PurePosixPath(name).name for name in below]
    count = Counter(map(stem, bare))
    return [
        (name, last) if count[stem(last)] == 1 and last != name else (name,)
        for name, last in zip(below, bare, strict=True)
    ]


def _find_shift(photographs: Iterable[str], masks: Iterable[str]) -> int:
    """By how much the masks' numbers are ahead of the photographs', such as 1 for images 000..035 and masks
    001..036; 0 unless most photographs, and more than as they are named, have a mask when they are moved on."""

    def numbers(names: Iterable[str]) -> dict[str, set[int]]:
        groups = defaultdict(set)
        for name in names:
            if found := re.fullmatch(r"(.*?)(\d{1,18})\D*", stem(name), re.ASCII):
                groups[found[1]].add(int(found[2]))
        return groups

    there = numbers(masks)
    for start, wanted in numbers(photographs).items():
        extra = there[start] - wanted
        for shift in (max(extra) - max(wanted), min(extra) - min(wanted)) if extra else ():
            moved = {number + shift for number in wanted}
            named, fit = len(wanted & there[start]), len(moved & there[start])
            if extra <= moved and fit > max(named, len(wanted) / 2):
                return shift
    return 0
