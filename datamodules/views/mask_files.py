"""Which mask file belongs to which photograph."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import torch
from torch import Tensor

from datamodules.capture import Capture
from datamodules.files.images import ENDINGS, is_image_name
from datamodules.files.paths import inside, printable, stem
from datamodules.request import Request
from datamodules.views.find_files import loose_key
from visdom_plugin.errors import ConfigError, SceneError, did_you_mean, list_some

log = logging.getLogger(__name__)

OTHER_FOLDERS = (
    "mask", "matting", "mattings", "matte", "mattes", "alpha", "alphas", "silhouette", "silhouettes",
    "segmentation", "segmentations", "foreground", "object_mask", "object_masks", "image_mask", "images_mask",
    "image_masks", "images_masks", "mask_images", "masks_png", "mask_png", "sam_masks", "rembg",
)  # fmt: skip
"""Names under which folders of masks are known elsewhere."""


class MaskFiles(NamedTuple):
    """The mask file of each wanted frame, below the root, and how they were found where that is not plain."""

    of: dict[int, str | None]
    """By the frame's position; None where the alpha channel must do."""
    notes: tuple[str, ...] = ()


def below_root(masks: str, root: Path) -> str:
    """A folder of masks as it is called below the scene's folder.

    Args:
        masks: as a user names it: below the scene's folder, from the working directory, or absolute.

    Raises:
        ConfigError: it names two folders.
    """
    typed, own = Path(masks).expanduser(), root / masks
    if typed.is_absolute():
        return os.path.relpath(typed, root)
    if not typed.is_dir():
        return masks
    if own.is_dir() and not own.samefile(typed):
        raise ConfigError(
            f"two folders are called {printable(masks)}: one below the scene's folder, one from where you are",
            where=f"--masks {masks}",
            todo=f"name one by its whole path: {own.resolve()} or {typed.resolve()}",
            topic="mask-ambiguous",
        )
    return masks if own.is_dir() else os.path.relpath(typed.resolve(), root.resolve())


def assign_masks(capture: Capture, wanted: Sequence[int], request: Request) -> MaskFiles:
    """The mask file of each wanted frame.

    Raises:
        SceneError: wanted frames without a mask, or masks that look shifted against the photographs.
        ConfigError: a folder of masks is named, and none is needed.
    """
    named = {i: capture.frames[i].mask for i in wanted}
    open_ones = [i for i in wanted if named[i] is None]
    if not open_ones or request.mask_source == "alpha":
        if request.masks is not None and not all(
            str(name).startswith(f"{request.masks}/") for name in named.values()
        ):
            alpha = request.mask_source == "alpha"
            raise ConfigError(
                "masks are read from alpha channels"
                if alpha
                else "the data itself names each photograph's mask",
                where=f"--masks {request.masks}",
                todo="leave out --masks" + (", or --data.mask-source alpha" if alpha else ""),
                topic="mask-ambiguous",
            )
        return MaskFiles(named)
    photographs = _photographs(capture)
    folder, notes = _find_folder(capture, photographs, open_ones, request)
    if folder is None:
        return MaskFiles(named)
    path = inside(capture.root, folder, outside=request.allow_outside)
    there = _image_files(path)
    matched, affix = _match(photographs, there)
    if any(affix):
        notes.append(
            f"masks are named like their photographs, with {affix[0]!r} before and {affix[1]!r} after"
        )
    found: dict[int, str] = {}
    for i, files in matched.items():
        if len(files) > 1 and i in named:
            raise SceneError(
                f"{printable(photographs[i][0])} has more than one mask: {', '.join(map(printable, files))}",
                where=path,
                todo="keep the right one",
                topic="mask-ambiguous",
            )
        found[i] = f"{folder}/{files[0]}"
    missing = [i for i in open_ones if i not in found]
    used = {file for files in matched.values() for file in files}
    extra = sorted(printable(stem(name)) for name in there - used)
    shift = 0 if any(affix) else _find_shift((name for names in photographs for name in names), there)
    if (missing or shift) and not request.allow_missing_masks:
        missing = missing or [i for i in range(len(photographs)) if i not in found]
        hint = f"there are masks that no image has: {list_some(extra)}" if extra else None
        reason = f"the masks' numbers are shifted by {shift}" if shift else "masks named otherwise"
        looked = " or ".join(f"{folder}/{printable(stem(name))}.png" for name in photographs[missing[0]])
        todo = f"name each mask like its image, such as {looked}"
        cause = f"{reason}; {hint}" if hint else None
        if cause is None and (strange := _strange_files(path)):
            cause = f"it holds {list_some(map(printable, strange), 3)}, which are read as no image"
            todo = f"save masks as PNG, each named like its image, such as {looked}"
        # Where no view has a mask there is nothing to carve the others' from.
        if found or named.keys() - set(open_ones):
            todo += "; or leave views without out, with --train-list and --test-list; or keep them: "
            todo += (
                "--data.missing-masks colour (they train colours only) or hull (the hull draws their masks)"
            )
        raise SceneError(
            f"{len(missing)} of the images {'has' if len(missing) == 1 else 'have'} no mask: "
            + list_some([stem(photographs[i][0]) for i in missing]),
            where=path,
            cause=cause,
            todo=todo,
            topic="mask-missing",
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
    for note in notes:
        log.info("%s: %s", path, note)
    return MaskFiles({i: named[i] or found.get(i) for i in wanted}, tuple(notes))


def find_ignored(capture: Capture, wanted: Sequence[int], request: Request) -> dict[int, str]:
    """The files in the folder `ignore`, white where a frame's photograph tells nothing, below the root."""
    path = inside(capture.root, "ignore", outside=request.allow_outside)
    if not path.is_dir():
        return {}
    matched, _ = _match(_photographs(capture), _image_files(path))
    return {i: f"ignore/{matched[i][0]}" for i in wanted if i in matched}


def _find_folder(
    capture: Capture, photographs: Sequence[tuple[str, ...]], wanted: Sequence[int], request: Request
) -> tuple[str | None, list[str]]:
    """The folder of masks and a note on it: the one that the request names, the layout's, or, where that holds
    none, the only other one that is called like a folder of masks and holds one for each wanted photograph."""
    folder = request.masks or capture.mask_folder
    if folder is None:
        return None, []
    own = inside(capture.root, folder, outside=request.allow_outside)
    if request.masks:
        if own.is_dir():
            return folder, []
        there = sorted(path.name for path in capture.root.iterdir() if path.is_dir())
        raise SceneError(
            f"there is no folder {printable(folder)} for the masks{did_you_mean(folder, there)}",
            where=capture.root,
            todo="name one with --masks, below the scene's folder, or by its path from where you are",
            topic="mask-missing",
        )
    others = []
    for path in sorted(capture.root.iterdir()):
        named = path.name.lower() in (*OTHER_FOLDERS, folder.lower())
        if named and path.name != folder and path.is_dir():
            matched, _ = _match(photographs, _image_files(path))
            if all(len(matched.get(i, ())) == 1 for i in wanted):
                others.append(path.name)
    if own.is_dir() and (not others or _match(photographs, _image_files(own))[0].keys() & set(wanted)):
        too = [f"masks are read from {folder}, not from {list_some(others)} (--masks)"]
        return folder, too if others else []
    if len(others) == 1:
        return others[0], [f"masks are read from the folder {others[0]}, for want of {folder}"]
    if others:
        raise SceneError(
            f"the folder {folder} has no masks, and {' and '.join(others)} could stand in for it",
            where=capture.root,
            todo=f"say which holds masks that are white on the object: --masks {others[0]}",
            topic="mask-missing",
        )
    return None, []


def _image_files(path: Path) -> set[str]:
    below = (file.relative_to(path) for file in path.rglob("*"))
    return {file.as_posix() for file in below if is_image_name(file)}


def _match(
    photographs: Sequence[tuple[str, ...]], files: set[str]
) -> tuple[dict[int, list[str]], tuple[str, str]]:
    """Files by the photograph's position, and what all their names have before and after the photograph's.

    A file is named like its photograph, with or without the latter's ending, or with _mask behind; ending, case
    and Unicode form may differ where that is unambiguous. The photograph's folders may be repeated, or left out.
    """
    exact, loose = defaultdict(list), defaultdict(list)
    for file in sorted(files, key=lambda name: (ENDINGS.index(PurePosixPath(name).suffix.lower()), name)):
        exact[stem(file)].append(file)
        loose[loose_key(file)].append(file)

    def look_up(names: tuple[str, ...], before: str = "", after: str = "") -> list[str]:
        for table, key in ((exact, str), (loose, _fold)):
            for name in names:
                path = PurePosixPath(stem(name))
                starts = [str(path), name, f"{path}_mask"]
                if before or after:
                    starts = [str(path.with_name(f"{before}{path.name}{after}"))]
                if hits := [file for start in starts for file in table.get(key(start), ())]:
                    return list(dict.fromkeys(hits))
        return []

    found = {i: hits for i, names in enumerate(photographs) if (hits := look_up(names))}
    if files and photographs and not found:
        # masks/images/v01.png: the folder of photographs was masked as a whole.
        folder = os.path.commonpath([PurePosixPath(file).parent for file in files])
        if folder:
            below, affix = _match(photographs, {file.removeprefix(f"{folder}/") for file in files})
            if below:
                return {i: [f"{folder}/{file}" for file in hits] for i, hits in below.items()}, affix
        # Tools add the same to every name: cup-removebg-preview, mask_cup, cup.mask.
        name = PurePosixPath(stem(photographs[0][0])).name
        for file in sorted(files):
            before, here, after = PurePosixPath(stem(file)).name.partition(name)
            if here and not before[-1:].isalnum() and not after[:1].isalnum():
                every = {i: look_up(names, before, after) for i, names in enumerate(photographs)}
                if all(len(files_of) == 1 for files_of in every.values()):
                    return every, (before, after)
    return found, ("", "")


def _fold(start: str) -> str:
    return loose_key(f"{start}.png")


def _strange_files(path: Path) -> list[str]:
    """What lies in a folder of masks that is no image, by name."""
    found = (p for p in path.iterdir() if p.is_file() and not p.name.startswith("."))
    return sorted(p.name for p in found if p.suffix.lower() not in ENDINGS)


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
