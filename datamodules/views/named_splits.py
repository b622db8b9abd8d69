"""Splits of publications, by name: which cameras of a data set's scenes train and which test.

A split is a CSV file in `published_splits/`, whose comment says where it is from, with the columns dataset, scene,
views, train, test. Positions are zero-based. For mip360 and omni3d they count all registered photographs, sorted
by name; for actorshq they name the rig's cameras, 0 being Cam001, since a copy of a sequence may lack some.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from datamodules.request import Request
from datamodules.views.splits import Split, every_eighth
from visdom_plugin.errors import ConfigError, SceneError, list_some

FRAMES = {"visdom": 12}
"""Frame of a video layout that a split was made for; VisDom: the release's scripts for ActorsHQ."""
_FOLDER = resources.files("datamodules.views") / "published_splits"


class Row(NamedTuple):
    """One scene at one number of training views."""

    dataset: str
    scene: str
    views: int
    train: tuple[int, ...]
    test: tuple[int, ...]


def list_names() -> list[str]:
    """Names of the splits that are shipped."""
    return sorted(file.name[:-4] for file in _FOLDER.iterdir() if file.name.endswith(".csv"))


@cache
def load_rows(name: str) -> tuple[Row, ...]:
    """All rows of a split.

    Raises:
        ConfigError: there is no such split.
    """
    if name not in list_names():
        raise ConfigError(
            f"there is no split {name!r}",
            where="--split",
            todo=f"use one of: {', '.join(list_names())}",
            topic="which-views",
        )
    text = (_FOLDER / f"{name}.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return tuple(
        Row(r["dataset"], r["scene"], int(r["views"]), _numbers(r["train"]), _numbers(r["test"]))
        for r in csv.DictReader(lines)
    )


def choose_named(root: Path, names: Sequence[str], request: Request) -> Split:
    """The views of the request's split.

    Args:
        root: the scene's folder. It, or a folder above it, is named after the scene, unless the request's split
            is spelled NAME:SCENE.
        names: of all views, in the layout's order.

    Raises:
        ConfigError: no such split; the split has no such scene, or not at this number of views; a list of views is
            given as well.
        SceneError: the scene's photographs are not those that the split was made for.
    """
    name, _, scene = (request.split or "").partition(":")
    rows = load_rows(name)
    if request.train_list is not None or request.test_list is not None:
        raise ConfigError(
            "--split and a list of views are given",
            where=f"--split {request.split}",
            todo="leave out --split, or --train-list and --test-list",
            topic="which-views",
        )
    row = _find_row(name, _find_scene(rows, scene, root, request), request.views, rows)
    _check_fit(row, names, root, name)
    offset = _positions(row, names)
    train, test = [offset[i] for i in row.train], [offset[i] for i in row.test]
    rule = f"split {name} of {row.scene} at {row.views} views"
    return Split(train, test if request.test else [], {}, rule)


def _find_scene(rows: Sequence[Row], scene: str, root: Path, request: Request) -> str:
    known = list(dict.fromkeys(row.scene for row in rows))
    candidates = [scene] if scene else list(reversed(root.resolve().parts))[:3]
    # Two Omni3D objects carry their size in the release's names, which other copies of the data leave out.
    spelled = {name.removesuffix("_1080"): name for name in known} | {name: name for name in known}
    found = [spelled[c] for c in candidates if c in spelled]
    if not found:
        raise ConfigError(
            f"the split has no scene {candidates[0]!r}",
            where=f"--split {request.split}: {root}",
            cause=None if scene else "the scene is known by the name of its folder",
            todo=f"name it with --split {request.split}:SCENE, SCENE one of {', '.join(known)}"
            if not scene
            else f"use one of {', '.join(known)}",
            topic="which-views",
        )
    return found[0]


def _find_row(name: str, scene: str, views: int | None, rows: Sequence[Row]) -> Row:
    of_scene = {row.views: row for row in rows if row.scene == scene}
    wanted = min(of_scene) if views is None else views
    if wanted not in of_scene:
        listed = ", ".join(map(str, of_scene))
        raise ConfigError(
            f"the split has no {wanted} training views of {scene}",
            where=f"--split {name}",
            todo=f"pass --views with one of {listed}",
            topic="which-views",
        )
    return of_scene[wanted]


def _check_fit(row: Row, names: Sequence[str], root: Path, split: str) -> None:
    """Refuses a scene with other photographs than the split counts, as far as the split tells."""
    if row.dataset == "actorshq":
        missing = [n for n in map(_rig_name, (*row.train, *row.test)) if n not in names]
        what = f"cameras {list_some(missing, 6)} are not in calibration.csv" if missing else None
    elif row.dataset == "mip360" and list(every_eighth(range(len(names))).test) != sorted(row.test):
        last = 8 * len(row.test)
        what = f"{len(names)} photographs are registered; the split is of {last - 7} to {last}"
    elif max(*row.train, *row.test) >= len(names):
        what = (
            f"{len(names)} photographs are registered; the split counts to {max(*row.train, *row.test) + 1}"
        )
    else:
        what = None
    if what is not None:
        raise SceneError(
            f"the split {split} does not fit this scene: {what}",
            where=root,
            cause=f"another scene than {row.dataset}'s {row.scene}, or a model with fewer photographs",
            todo="use the published data, or list views by hand with --train-list and --test-list",
            topic="which-views",
        )


def _positions(row: Row, names: Sequence[str]) -> dict[int, int]:
    """Positions in the layout's order by the split's."""
    if row.dataset != "actorshq":
        return {i: i for i in range(len(names))}
    of_name = {name: i for i, name in enumerate(names)}
    return {i: of_name[_rig_name(i)] for i in (*row.train, *row.test)}


def _rig_name(position: int) -> str:
    return f"Cam{position + 1:03d}"


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split()))
