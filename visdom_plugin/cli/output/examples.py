"""Examples of each command, shown before its options."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

RUN = "runs/SCENE/VIEWS/METHOD/SEED"
EXAMPLES: dict[str, tuple[str, ...]] = {
    "check": ("visdom-check DIR",),
    "convert": (
        "visdom-convert DIR --out calibration.csv",
        "visdom-convert calibration.csv --out DIR/sparse/0",
    ),
    "evaluate": (
        f"visdom-eval {RUN}",
        "visdom-eval --leave-one-out method:ingp+vd --data DIR --views 4",
    ),
    "export": (f"visdom-export {RUN} --format glb", f"visdom-export {RUN} --format html --upright"),
    "hull": ("visdom-hull DIR --views 4 --k 3 --out hull.ply",),
    "methods": ("visdom-methods --doctor",),
    "prepare": ("visdom-prepare --print-board board.pdf", "visdom-prepare PHOTOS --out DIR"),
    "render": (f"visdom-render {RUN} --path orbit", "visdom-render point_cloud.ply --data DIR"),
    "report": (f"visdom-report {RUN} OTHER_RUN",),
    "table": ("visdom-table ablation --data DIR --views 4 method:ingp", "visdom-table main:smoke"),
    "train": ("visdom-train method:zipnerf+vd", "visdom-train method:visdom-gs --data DIR --views 4"),
    "view": (f"visdom-view {RUN}", "visdom-view DIR"),
}
"""By the module of the command, the one to try first at the front."""
_SUBJECTS = {
    "convert": "no model and no table is named",
    "evaluate": "no run is named",
    "export": "no run, file or scene is named",
    "render": "no run and no file is named",
}
"""What is missing where a command that cannot do without is called without words."""


def examples_of(command: Callable[..., Any]) -> tuple[str, ...]:
    """The examples of the command that a function of its module runs; none for a stranger's."""
    return EXAMPLES.get(Path(command.__code__.co_filename).stem, ())


def program_of(command: Callable[..., Any]) -> str | None:
    """Its name on the command line."""
    examples = examples_of(command)
    return examples[0].split()[0] if examples else None


def missing_subject(command: Callable[..., Any]) -> str | None:
    """What a command lacks when it is called without words; None where it needs none, or says so itself."""
    return _SUBJECTS.get(Path(command.__code__.co_filename).stem)
