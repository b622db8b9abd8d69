"""Cameras as other programs list them, and how they are matched with photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datamodules.files.images import ENDINGS
from datamodules.files.masks import fits
from datamodules.files.paths import stem
from datamodules.files.pinholes import pinholes
from datamodules.files.undistort import Distortion
from datamodules.views.find_files import loose_key
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.prepare.placed import Placed


@dataclass(frozen=True)
class Listed:
    """Cameras of a file."""

    source: str
    """The program, for people."""
    names: Sequence[str] | None
    """Of the photographs; None where the file has none, so that they go by order."""
    K: np.ndarray
    """(N, 4) fx, fy, cx, cy in pixels of `sizes`, origin at the image's corner."""
    sizes: Sequence[tuple[int, int] | None]
    """Width and height that each camera was calibrated for; None for the photograph's own, as stored."""
    poses: np.ndarray
    """(N, 3 or 4, 4) camera to world."""
    distortions: Sequence[Distortion | None]
    convention: str = "opencv"
    """Axes of the poses: opencv or opengl."""
    units: str = "unknown"
    notes: list[str] = field(default_factory=list)


def match(listed: Listed, photographs: Sequence[Photograph], where: Path) -> Placed:
    """Gives each photograph its camera.

    Raises:
        SceneError: names or counts do not fit, or a camera is impossible.
    """
    pairs, notes = _pair(listed, photographs, where)
    chosen = [photographs[i] for i, _ in pairs]
    index = [j for _, j in pairs]
    sizes = [_size(listed.sizes[j], photographs[i], where) for i, j in pairs]
    cameras = pinholes(
        listed.K[index],
        listed.poses[index],
        sizes,
        names=[p.name for p in chosen],
        where=where,
        convention=listed.convention,
    )
    known = {i for i, _ in pairs}
    left = {p.name: f"has no camera in {where.name}" for i, p in enumerate(photographs) if i not in known}
    distortions = [listed.distortions[j] for j in index]
    for p, d in zip(chosen, distortions, strict=True):
        if d is not None:
            d.check(f"{where}, {p.name}")
    return Placed(
        chosen,
        cameras,
        distortions,
        listed.source,
        listed.units,
        left_out=left,
        notes=[*listed.notes, *notes],
    )


def _pair(
    listed: Listed, photographs: Sequence[Photograph], where: Path
) -> tuple[list[tuple[int, int]], list[str]]:
    if listed.names is None:
        if len(listed.K) != len(photographs):
            raise SceneError(
                f"{where.name} has {len(listed.K)} cameras without names for {len(photographs)} photographs",
                where=where,
                cause="photographs were added or left out after the poses were estimated",
                todo="put exactly the photographs into the folder that the poses were estimated from",
                topic="unmatched-poses",
            )
        note = f"{where.name} names no photographs: its cameras go to them in the order of their names"
        return [(i, i) for i in range(len(photographs))], [note]
    by_key: dict[str, list[int]] = {}
    for j, name in enumerate(listed.names):
        by_key.setdefault(_key(name), []).append(j)
    twice = [listed.names[js[0]] for js in by_key.values() if len(js) > 1]
    if twice:
        raise SceneError(
            f"{where.name} has several cameras for {list_some(twice)}",
            where=where,
            cause="photographs in several folders under one name, or two models in one file",
            todo="rename the photographs so that each name occurs once, and export again",
            topic="unmatched-poses",
        )
    pairs = [(i, by_key[_key(p.name)][0]) for i, p in enumerate(photographs) if _key(p.name) in by_key]
    if len(pairs) < 2:
        raise SceneError(
            f"{len(pairs)} of {len(photographs)} photographs have a camera in {where.name}: photographs are named "
            f"{list_some([p.name for p in photographs], 2)}, cameras {list_some(listed.names, 2)}",
            where=where,
            cause="the poses are of other photographs, or these were renamed",
            todo="name the photographs as in that file, and have two at least",
            topic="unmatched-poses",
        )
    used = {j for _, j in pairs}
    spare = [name for j, name in enumerate(listed.names) if j not in used]
    notes = [f"{len(spare)} cameras have no photograph here: {list_some(spare, 3)}"] if spare else []
    return pairs, notes


def _key(name: str) -> str:
    """What a photograph's names in different programs have in common: no folder, no ending, no case."""
    last = name.replace("\\", "/").rpartition("/")[2]
    return loose_key((stem(last) if last.lower().endswith(ENDINGS) else last) + ".png")


def _size(size: tuple[int, int] | None, photograph: Photograph, where: Path) -> tuple[int, int]:
    """The size that a camera speaks of: the photograph's, turned or not, or that of an even copy."""
    if size is None:
        return photograph.size
    stored = photograph.size
    if fits(stored, size) or (photograph.orientation >= 5 and fits(stored[::-1], size)):
        return size
    raise SceneError(
        f"{photograph.name} is {stored[0]} x {stored[1]}, its camera is for {size[0]} x {size[1]}",
        where=where,
        cause="the photographs were cropped, undistorted or turned after the poses were estimated, or before",
        todo="use the photographs that the poses were estimated from",
        topic="photograph-size",
    )
