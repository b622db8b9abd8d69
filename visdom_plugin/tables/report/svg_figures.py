"""Figures of the page as inline SVG: training curves, and the spread over seeds.

Colours of middle brightness, so that they show on light and dark pages; the page's style may refine them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path

import numpy as np

from visdom_plugin.tables.measures import Measure

HUES = (210, 25, 140, 330, 265, 45, 185, 0, 90, 235)
"""Of lines, in degrees; later ones are dashed."""
_POINTS = 40
_WIDTH, _HEIGHT = 560, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 24, 10, 30
_DOT, _PAPER = "hsl(210,65%,50%)", "hsl(25,75%,50%)"


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
    path = Path(run_dir) / "log.jsonl"
    try:
        return _read_log(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=8192)
def _read_log(path: Path, written: int) -> np.ndarray | None:
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
    if len(points) < 2:
        return None
    return np.array(sorted(points)) / (last, 1.0)


def average_curves(curves: Sequence[np.ndarray]) -> np.ndarray:
    """(40, 2): the mean of several curves where all of them have values, in between straight."""
    low, high = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    at = np.linspace(low, max(low, high), _POINTS)
    return np.stack([at, np.mean([np.interp(at, c[:, 0], c[:, 1]) for c in curves], axis=0)], axis=1)


def draw_curves(series: Sequence[tuple[int, str, np.ndarray]]) -> str:
    """Training PSNR over the share of each method's schedule.

    Args:
        series: colour number, label and (n, 2) curve of each line.
    """
    values = np.concatenate([curve[:, 1] for _, _, curve in series])
    low, high, ticks = _nice(float(values.min()), float(values.max()))

    def place(share: float, value: float) -> tuple[float, float]:
        x = _LEFT + share * (_WIDTH - _LEFT - _RIGHT)
        return x, _HEIGHT - _BOTTOM - (value - low) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    parts = []
    for tick in ticks:
        x, y = place(0, tick)
        parts.append(
            f'<line class="grid" stroke="#bbb" x1="{x}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}"/>'
        )
        parts.append(f'<text x="{x - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for share in (0, 0.5, 1):
        x, _ = place(share, low)
        parts.append(f'<text x="{x:.0f}" y="{_HEIGHT - 12}" text-anchor="middle">{share:.0%}</text>')
    for colour, label, curve in series:
        points = " ".join("{:.1f},{:.1f}".format(*place(x, y)) for x, y in curve)
        parts.append(f'<polyline fill="none" {_pen(colour)} points="{points}">{_title(label)}</polyline>')
    return _svg(_HEIGHT, "training PSNR over the share of the schedule", parts)


def draw_spread(rows: Sequence[Dots], measure: Measure) -> str:
    """Each row's seeds as dots, their mean as a bar, the paper's number as a hollow diamond."""
    values = [v for row in rows for v in (*row.seeds, *([] if row.paper is None else [row.paper]))]
    low, high, ticks = _nice(min(values), max(values))
    left, pitch = 150, 20
    height = _TOP + pitch * len(rows) + _BOTTOM

    def place(value: float) -> float:
        return left + (value - low) / (high - low) * (_WIDTH - left - _RIGHT)

    parts = []
    for tick in ticks:
        x = place(tick)
        parts.append(
            f'<line class="grid" stroke="#bbb" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{height - _BOTTOM}"/>'
        )
        parts.append(f'<text x="{x:.1f}" y="{height - 12}" text-anchor="middle">{tick:g}</text>')
    for i, row in enumerate(rows):
        y = _TOP + pitch * (i + 0.5)
        label = row.label if len(row.label) <= 22 else row.label[:21] + "…"
        parts.append(f'<text x="{left - 8}" y="{y + 4}" text-anchor="end">{escape(label)}</text>')
        if row.paper is not None:
            x = place(row.paper)
            said = _title(f"{row.label}: paper {measure.spell(row.paper)}")
            parts.append(
                f'<path fill="none" stroke="{_PAPER}" d="M{x:.1f} {y - 6}l6 6l-6 6l-6 -6z">{said}</path>'
            )
        x = place(row.mean)
        pen = 'class="mean" stroke="#777" stroke-width="2"'
        parts.append(f'<line {pen} x1="{x:.1f}" y1="{y - 7}" x2="{x:.1f}" y2="{y + 7}"/>')
        for value in row.seeds:
            said = _title(f"{row.label}: {measure.spell(value)}")
            parts.append(f'<circle fill="{_DOT}" cx="{place(value):.1f}" cy="{y}" r="3.5">{said}</circle>')
    return _svg(height, f"{measure.title}: seeds, mean and the paper's number", parts)


def swatch(colour: int) -> str:
    """A short line in a colour, for a legend."""
    line = f'<line {_pen(colour)} x1="1" y1="6" x2="25" y2="6"/>'
    return f'<svg class="swatch" viewBox="0 0 26 12" width="26" height="12" aria-hidden="true">{line}</svg>'


def _pen(number: int) -> str:
    dashes = ' stroke-dasharray="5 3"' if number // len(HUES) % 2 else ""
    return f'stroke="hsl({HUES[number % len(HUES)]},65%,50%)" stroke-width="2"{dashes}'


def _title(text: str) -> str:
    return f"<title>{escape(text)}</title>"


def _svg(height: float, label: str, parts: list[str]) -> str:
    size = f'viewBox="0 0 {_WIDTH} {height}" font-size="11"'
    head = f'<svg class="figure" {size} role="img" aria-label="{escape(label)}">'
    return head + "".join(parts) + "</svg>"


def _nice(low: float, high: float) -> tuple[float, float, list[float]]:
    """Round limits that hold both, and the round numbers between them."""
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1.0))
    step = 10 ** np.floor(np.log10(span / 3))
    step = float(step * next(f for f in (1, 2, 5, 10) if span / (step * f) <= 6))
    first, last = np.floor(low / step), np.ceil(high / step)
    if first == last:
        last += 1
    ticks = [float(round(n * step, 12)) for n in np.arange(first, last + 1)]
    return ticks[0], ticks[-1], ticks
