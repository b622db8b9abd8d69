"""Figures of the page as inline SVG: training curves, and the spread over seeds.

Colours of middle brightness, so that they show on light and dark pages; the page's style colours the words.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from visdom_plugin.figures.canvas import TIP, drawing, printable, to_svg
from visdom_plugin.tables.measures import Measure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POINTS = 40
_WIDTH, _HEIGHT = 560, 240
_DOT, _MEAN, _PAPER, _GRID = "#2c7fc9", "#777777", "#df6d20", "#99999966"


@dataclass(frozen=True)
class Dots:
    """One row of the spread figure."""

    label: str
    seeds: tuple[float, ...]
    mean: float
    paper: float | None


def read_curve(run_dir: Path) -> np.ndarray | None:
    """(n, 2): share of the schedule done and PSNR of a training view, from log.jsonl; None without any.

    Lines that cannot be read are left out.
    """
    points, last = _read_log(run_dir)
    return np.array(sorted(points)) / (last, 1.0) if len(points) > 1 else None


def read_last_step(run_dir: Path) -> int:
    """The step at which the curve of `read_curve` ends; 0 where nothing was logged."""
    return _read_log(run_dir)[1]


def _read_log(run_dir: Path) -> tuple[list[tuple[int, float]], int]:
    """(step, PSNR) where it was measured, and the last step that was logged."""
    path = Path(run_dir) / "log.jsonl"
    try:
        return _parse_log(path, path.stat().st_mtime_ns)
    except OSError:
        return [], 0


@lru_cache(maxsize=8192)
def _parse_log(path: Path, written: int) -> tuple[list[tuple[int, float]], int]:
    """`written`: the file's age, so that a driver that writes its table many times reads each log once."""
    points, last = [], 0
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
            step, value = int(row["step"]), row.get("psnr")
        except (ValueError, KeyError, TypeError, AttributeError):
            continue
        last = max(last, step)
        if isinstance(value, (int, float)) and np.isfinite(value):
            points.append((step, float(value)))
    return points, last


def average_curves(curves: Sequence[np.ndarray]) -> np.ndarray:
    """(40, 2): the mean of several curves where all of them have values, in between straight."""
    low, high = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    at = np.linspace(low, max(low, high), _POINTS)
    return np.stack([at, np.mean([np.interp(at, c[:, 0], c[:, 1]) for c in curves], axis=0)], axis=1)


def draw_curves(
    series: Sequence[tuple[int, str, np.ndarray]], marks: Mapping[str, Sequence[float]] | None = None
) -> str:
    """Training PSNR over the share of each method's schedule.

    Args:
        series: colour number, label and (n, 2) curve of each line.
        marks: what happened at which shares of the schedule; a dotted line each, the first with its name.
    """
    with drawing():
        figure, axes = _make_axes(_HEIGHT, left=46, grid="y")
        for number, label, curve in series:
            colour, dash = pen(number)
            (line,) = axes.plot(*curve.T, color=colour, linestyle=dash, linewidth=2, clip_on=False)
            line.set_gid(TIP + printable(label))
        for what, shares in (marks or {}).items():
            for share in shares:
                line = axes.axvline(share, color=_MEAN, linestyle="dotted", linewidth=1)
                line.set_gid(TIP + printable(what))
            place = axes.get_xaxis_transform()
            text = f" {printable(what)}"
            axes.text(
                shares[0], 0.02, text, transform=place, rotation=90, fontsize=9, color=_MEAN, ha="right"
            )
        axes.set_xlim(0, 1)
        axes.set_xticks([0, 0.5, 1], ["0%", "50%", "100%"])
        return to_svg(figure, "training PSNR over the share of the schedule")


@lru_cache(maxsize=1024)
def draw_spread(rows: tuple[Dots, ...], measure: Measure) -> str:
    """Each row's seeds as dots, their mean as a bar, the paper's number as a hollow diamond."""
    with drawing():
        figure, axes = _make_axes(20 * len(rows) + 40, left=180, grid="x")
        mark: Any = {"linestyle": "none", "clip_on": False}
        for y, row in enumerate(rows):
            tip = f"{TIP}{printable(row.label)}: "
            if row.paper is not None:
                said = f"{tip}paper {measure.spell(row.paper)}"
                axes.plot(row.paper, y, "D", mfc="none", mec=_PAPER, ms=8, gid=said, **mark)
            axes.plot(row.mean, y, "|", color=_MEAN, ms=14, mew=2, **mark)
            for value in row.seeds:
                axes.plot(value, y, "o", color=_DOT, mew=0, ms=7, gid=tip + measure.spell(value), **mark)
        labels = [printable(row.label) for row in rows]
        axes.set_yticks(range(len(rows)), [x if len(x) <= 22 else x[:21] + "…" for x in labels])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        return to_svg(figure, f"{measure.title}: seeds, mean and the paper's number")


def pen(number: int) -> tuple[str, str]:
    """Colour and dashes ("solid" or "dashed") of a line."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return to_hex(colormaps["tab10"](number % 10)), "dashed" if number // 10 % 2 else "solid"


def _make_axes(height: int, left: int, grid: Literal["x", "y"]) -> tuple[Figure, Axes]:
    """Axes without frame and ticks, so that the grid alone carries the numbers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH / 72, height / 72), facecolor="none")
    axes = figure.add_axes(
        (left / _WIDTH, 30 / height, (_WIDTH - left - 24) / _WIDTH, 1 - 40 / height), facecolor="none"
    )
    axes.spines[:].set_visible(False)
    axes.tick_params(left=False, bottom=False)
    axes.grid(axis=grid, color=_GRID, clip_on=False)
    axes.set_axisbelow(True)
    axes.ticklabel_format(useOffset=False, style="plain")
    return figure, axes
