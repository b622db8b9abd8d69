"""Scenes from captures: the views of a request chosen, read and brought to size.

A layout's reader returns a `Capture`; `open_capture` chooses the views of the request, asks for the cameras of
these alone, reads their pixels and brings everything to the wanted size.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from glob import escape
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import torch
from torch import Tensor

from datamodules.capture import Capture, Frame, LoadedView, Pools
from datamodules.files.colmap_points import read_points
from datamodules.files.not_a_mask import DOUBTFUL
from datamodules.files.paths import check_name, inside, printable, stem
from datamodules.hashing import hash_parts
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.find_files import ImageFiles
from datamodules.views.lazy import LaterViews
from datamodules.views.mask_files import assign_masks, below_root, find_ignored, looks_inverted
from datamodules.views.named_splits import choose_named
from datamodules.views.reader import ViewReader, map_on_cores
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Scene, Views

log = logging.getLogger(__name__)


class Chosen(NamedTuple):
    """The views of a request, and where their pixels lie."""

    split: splits.Split
    folder: str | None
    """Of the photographs."""
    factor: float
    """How much smaller the photographs' files are than the cameras say."""
    files: list[Frame]
    """The training views, then the test views, each file under the name that it has on disk."""
    notes: list[str]
    """How files were found, where that is not plain."""
    request: Request
    """The request, with its folder of masks as it is called below the scene's."""


def choose_files(capture: Capture, request: Request) -> Chosen:
    """The views of a request and their files, none of which is opened.

    Raises:
        SceneError: for views, folders or masks that are not there.
        ConfigError: for a list given by hand that does not fit the data.
    """
    if not capture.frames:
        raise SceneError(
            "the scene has no photographs",
            where=capture.root,
            cause="the file of poses lists none, or was copied only in part",
            todo="copy or export the poses again",
            topic="no-scene",
        )
    if request.masks is not None:
        request = replace(request, masks=below_root(request.masks, capture.root))
    _check_names(capture, request)
    names = [frame.name for frame in capture.frames]
    folder, factor = _photographs(capture, request.downscale / capture.shrunk, request)
    there = ImageFiles(capture.root)
    asked = [_name_in(folder, capture, frame.image) for frame in capture.frames]
    found = [there.find(name) for name in asked]
    notes = _note_found(capture, asked, found)
    pools = _without(capture.pools, [i for i, image in enumerate(found) if image is None], len(found))
    if request.split is None:
        split = splits.choose(capture.root, names, request, pools, indexed=capture.indexed)
    else:
        split = choose_named(capture.root, names, request)
    wanted = [*split.train, *split.test]
    _refuse_absent(there, [asked[i] for i in wanted if found[i] is None])
    masks = assign_masks(capture, wanted, request)
    ignored = find_ignored(capture, wanted, request)
    files = [
        _files(capture.frames[i], found[i] or asked[i], masks.of[i], ignored.get(i), there) for i in wanted
    ]
    return Chosen(split, folder, factor, files, [*notes, *masks.notes], request)


class FreeViews(NamedTuple):
    """Views over which the training views are spread."""

    names: tuple[str, ...]
    cameras: Cameras


def find_free_views(capture: Capture, request: Request) -> FreeViews | None:
    """The views that could train where nobody says which; None where a list, an index file or a split does.

    No pixel is read.

    Raises:
        SceneError: for faults of the choice of views and of their cameras.
    """
    free = choose_files(capture, replace(request, test=False)).split.free
    if not free:
        return None
    return FreeViews(tuple(capture.frames[i].name for i in free), capture.calibrate(free).cameras)


def open_capture(capture: Capture, request: Request) -> Scene:
    """The scene of a request.

    With a downscale F the files of `<photographs>_<F>` are taken as they are where that folder exists;
    otherwise photographs are averaged over areas to round(size / F). Masks are averaged in the same way and
    cut at one half. Intrinsics follow each axis's exact ratio. Training views are decoded on all cores; the files
    of test views are checked, and their photographs decoded when they are first looked at.

    Raises:
        SceneError: for every fault of the data.
        ConfigError: for a list given by hand that does not fit the data.
    """
    split, folder, factor, files, found, request = choose_files(capture, request)
    names = [frame.name for frame in capture.frames]
    calibration = capture.calibrate([*split.train, *split.test])
    reader = ViewReader(files, calibration, factor, request.downscale / capture.shrunk, capture, request)
    n = len(split.train)
    loaded = map_on_cores(reader.read, range(n))
    later = LaterViews(lambda i: reader.read(n + i), map_on_cores(reader.inspect, range(n, len(files))))
    sizes = [(v.image.shape[1], v.image.shape[0]) for v in loaded] + [v.size for v in later.inspected]
    cameras = calibration.cameras.resized(*torch.tensor(sizes).reshape(-1, 2).unbind(1))
    train = _views(
        cameras[:n],
        [names[i] for i in split.train],
        lambda name: tuple(getattr(v, name) for v in loaded),
        [v.masked for v in loaded],
        ignoring=any(v.ignore is not None for v in loaded),
        deep=any(v.depth is not None for v in loaded),
    )
    bent = any(d is not None for d in calibration.distortions[n:])
    test = _views(
        cameras[n:],
        [names[i] for i in split.test],
        later.field,
        [v.masked for v in later.inspected],
        ignoring=bent or any(v.ignoring for v in later.inspected),
        deep=any(v.deep for v in later.inspected),
    )
    _warn_inverted(train)
    name = printable(capture.name or capture.root.resolve().name)
    source = {
        "root": name,
        "layout": capture.layout,
        "views": n,
        "downscale": float(request.downscale),
        "images": folder,
        "split": split.rule,
        "train": list(train.names),
        "test": list(test.names),
        **capture.source,
        "hashes": {**split.hashes, **hash_parts(train)},
    }
    notes = (
        f"layout {capture.layout}: {split.rule}",
        *capture.notes,
        *found,
        *_note_soft(loaded),
        *_note_remarks(loaded),
    )
    cloud = None
    if capture.points_file is not None:
        cloud = partial(_read_points, capture.root, capture.points_file, request.allow_outside)
    return Scene(
        name,
        train,
        test,
        capture.units,
        source,
        notes=notes,
        all_train=split.all_train,
        grey_masks=_doubt_grey(train.names, loaded),
        read_points=cloud,
    )


def _read_points(root: Path, file: str, outside: bool) -> tuple[Tensor, Tensor] | None:
    xyz, rgb = read_points(root, file, outside=outside)
    return (torch.from_numpy(xyz), torch.from_numpy(rgb).float() / 255) if len(xyz) else None


def _check_names(capture: Capture, request: Request) -> None:
    for frame in capture.frames:
        check_name(frame.name, capture.root, outside=request.allow_outside)
    ordered = sorted((stem(frame.name), frame.name) for frame in capture.frames)
    for (one, first), (two, second) in pairwise(ordered):
        if one == two:
            twice = first == second
            raise SceneError(
                f"two registered images share the name {printable(one)}: "
                + ("it is listed twice" if twice else f"{printable(first)} and {printable(second)}"),
                where=capture.root,
                cause="two models or lists merged into one"
                if twice
                else "positions in the index files and masks are found by this name",
                todo="list each photograph once" if twice else "rename one of them",
                topic="photograph",
            )


def _photographs(capture: Capture, downscale: float, request: Request) -> tuple[str | None, float]:
    """The folder to read, and how much smaller its files are than the cameras say."""
    base, root, outside = capture.photographs, capture.root, request.allow_outside
    if base is None:
        return None, 1.0
    smaller = f"{base}_{downscale:g}"
    if downscale > 1 and inside(root, smaller, outside=outside).is_dir():
        return smaller, downscale
    if inside(root, base, outside=outside).is_dir():
        return base, 1.0
    others = sorted(p.name for p in root.glob(f"{PurePosixPath(base).name}_*") if p.is_dir())
    others = [name for name in others if name.rpartition("_")[2].replace(".", "", 1).isdecimal()]
    if not others and any(ImageFiles(root).find(frame.image) for frame in capture.frames[:1]):
        return base, 1.0
    raise SceneError(
        f"the folder {base} is missing"
        + (f"; there is {', '.join(map(printable, others))}" if others else ""),
        where=root,
        todo=f"pass --downscale {printable(others[0].rpartition('_')[2])}"
        if others
        else "put the photographs there",
        topic="photograph",
    )


def _name_in(folder: str | None, capture: Capture, image: str) -> str:
    """A photograph's name, in the folder of smaller copies where these are read."""
    below = image.removeprefix(f"{capture.photographs}/")
    return image if folder in (None, capture.photographs) or below == image else f"{folder}/{below}"


def _note_found(capture: Capture, asked: Sequence[str], found: Sequence[str | None]) -> list[str]:
    """What is to be said of photographs under other names and of those that are not there."""
    notes = []
    other = [(a, f) for a, f in zip(asked, found, strict=True) if f is not None and f != a]
    if other:
        notes.append(
            f"{len(other)} of {len(asked)} photographs lie under another name than the poses give: "
            f"{printable(other[0][1])} for {printable(other[0][0])}"
        )
    absent = sorted(i for i in {*capture.pools.train, *capture.pools.test} if found[i] is None)
    if absent and len(absent) < len(asked):
        names = list_some([printable(capture.frames[i].name) for i in absent])
        notes.append(f"{len(absent)} of {len(asked)} frames have no photograph and are left out: {names}")
    for note in notes:
        log.warning("%s: %s", capture.root, note)
    return notes


def _without(pools: Pools, absent: Sequence[int], count: int) -> Pools:
    """The layout's split of the views that have a photograph; of all where none has, so that this is told."""
    if not absent or len(absent) == count:
        return pools
    if pools == splits.every_eighth(range(count)):
        return splits.every_eighth([i for i in range(count) if i not in absent])
    train, test = (tuple(i for i in part if i not in absent) for part in (pools.train, pools.test))
    return Pools(train, test, pools.rule)


def _refuse_absent(there: ImageFiles, absent: Sequence[str]) -> None:
    if not absent:
        return
    what = f"{len(absent)} of the photographs that are asked for are missing"
    path = there.root / absent[0]
    other = next(path.parent.glob(f"{escape(path.stem)}.*"), None) if path.parent.is_dir() else None
    if other is not None:
        raise SceneError(
            f"{what}; there is {printable(other.name)}",
            where=path,
            cause=f"photographs in a format that is not read, {printable(other.suffix)}",
            todo="convert them to PNG or JPEG",
            topic="photograph",
        )
    raise SceneError(
        f"{what}: {list_some([printable(name) for name in absent])}",
        where=path,
        cause="the scene was copied only in part, or the photographs were renamed",
        todo="copy them there, or list only views that have one, with --train-list and --test-list",
        topic="photograph",
    )


def _files(frame: Frame, image: str, mask: str | None, ignored: str | None, there: ImageFiles) -> Frame:
    def found(name: str | None) -> str | None:
        return name and (there.find(name, anywhere=False) or name)

    ignore, excluded = found(frame.ignore), found(frame.excluded or ignored)
    return replace(
        frame, image=image, mask=found(mask), ignore=ignore, excluded=excluded, depth=found(frame.depth)
    )


def _views(
    cameras: Cameras,
    names: Sequence[str],
    field: Callable[[str], Sequence[Any]],
    masked: Sequence[bool],
    *,
    ignoring: bool,
    deep: bool,
) -> Views:
    """Views from the fields of their `LoadedView`s.

    Args:
        field: of all views, by its name.
        masked: which views have a mask.
        ignoring: whether any may have ignored pixels.
        deep: whether any has a depth map.
    """
    return Views(
        cameras=cameras,
        images=field("image"),
        masks=field("mask"),
        names=tuple(names),
        mono_depths=field("depth") if deep else (),
        ignore=field("ignore") if ignoring else (),
        mask_origins=() if all(masked) else tuple("given" if m else "missing" for m in masked),
    )


def _note_soft(loaded: Sequence[LoadedView]) -> list[str]:
    shares = [v.soft for v in loaded if v.masked]
    mean = sum(shares) / max(len(shares), 1)
    return [f"soft masks: {mean:.1%} of their pixels are neither black nor white, cut at one half"] * (
        mean > 1e-3
    )


def _doubt_grey(names: Sequence[str], loaded: Sequence[LoadedView]) -> dict[str, float]:
    """Views whose mask is grey for too large a part, and that share; a warning tells of them."""
    found = {n: v.grey for n, v in zip(names, loaded, strict=True) if v.masked and v.grey > DOUBTFUL}
    if found:
        log.warning(
            "%d of %d masks are doubtful: up to %.0f%% of their pixels are neither black nor white, cut at one "
            "half; masks are white on the object and black around it",
            len(found),
            len(loaded),
            100 * max(found.values()),
        )
    return found


def _note_remarks(loaded: Sequence[LoadedView]) -> list[str]:
    counts = Counter(remark for view in loaded for remark in view.remarks)
    notes = [f"{count} of {len(loaded)} training views: {remark}" for remark, count in counts.items()]
    for note in notes:
        log.warning("%s", note)
    return notes


def _warn_inverted(views: Views) -> None:
    count = sum(looks_inverted(mask) for mask in views.masks)
    if 2 * count > len(views):
        log.warning("%d of %d training masks look inverted (white must be the object)", count, len(views))
