"""The figure of a paired ablation: a row of renders per variant, and bars of their numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visdom_plugin.scene import Views
from visdom_plugin.tables.results import Job, Outcome, Results

BARS = (("psnr", "PSNR", "dB", (76, 120, 168)), ("silhouette_iou", "IoU", "", (84, 162, 75)))
"""Metric, name, unit and colour of each bar."""
_BACK = 255


def draw_figure(results: Results, views: int, photographs: Views, shown: int) -> np.ndarray:
    """The figure, (H, W, 3) uint8 RGB.

    Args:
        results: of a table with one column; runs that are not finished leave their place grey.
        views: number of training views.
        photographs: the views that the runs were measured on, all of one run or one of each run.
        shown: how many of these to show, evenly chosen.
    """
    from visdom_plugin.figures.contact_sheet import draw_sheet, to_bytes
    from visdom_plugin.training.metrics import whiten

    rows = [[*results.select(row=i, views=views)] for i in range(len(results.spec.rows))]
    measured = {name for row in rows for _, o in row for name in _tested(o)}
    there = [i for i, name in enumerate(photographs.names) if not measured or name in measured]
    chosen = [there[round(p)] for p in np.linspace(0, len(there) - 1, min(shown, len(there)))]
    columns = []
    for i in chosen:
        truth = to_bytes(whiten(photographs.images[i], photographs.masks[i]))
        pictures = [truth, *(_render(row, photographs.names[i], truth.shape) for row in rows)]
        columns.append((photographs.names[i], pictures))
    numbers = [{metric: _mean(row, metric) for metric, *_ in BARS} for row in rows]
    size = columns[0][1][0].shape[:2]
    columns.append(
        ("means; longest bar = best", [np.full((*size, 3), _BACK, np.uint8), *_bars(numbers, size)])
    )
    return draw_sheet(columns, ["truth", *(row.label for row in results.spec.rows)])


def _tested(outcome: Outcome) -> Sequence[str]:
    return () if outcome.record is None else list(outcome.record["data"]["test"])


def _render(row: list[tuple[Job, Outcome]], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """A variant's picture of one view; grey where there is none."""
    from visdom_plugin.figures.contact_sheet import picture_names, read_png

    for job, outcome in row:
        names = _tested(outcome)
        if name in names and job.run_dir is not None:
            file = picture_names(names)[names.index(name)]
            try:
                return read_png(Path(job.run_dir) / "renders" / "test" / f"{file}.png")
            except OSError:
                break
    return np.full(shape, 200, np.uint8)


def _mean(row: list[tuple[Job, Outcome]], metric: str) -> float | None:
    values = [o.record["metrics"]["test"].get(metric) for _, o in row if o.status == "finished" and o.record]
    values = [v for v in values if v is not None]
    return math.fsum(values) / len(values) if values and len(values) == len(row) else None


def _bars(numbers: list[dict[str, float | None]], size: tuple[int, int]) -> list[np.ndarray]:
    """One picture per variant; a full bar is the best of its metric. Drawn at the sheet's size, to stay sharp."""
    from visdom_plugin.figures.canvas import Canvas
    from visdom_plugin.figures.contact_sheet import SHEET_WIDTH_PX

    width, height = SHEET_WIDTH_PX, max(60, round(size[0] * SHEET_WIDTH_PX / size[1]))
    most = {m: max((v for n in numbers if (v := n[m]) is not None), default=1.0) or 1.0 for m, *_ in BARS}
    pictures = []
    for row in numbers:
        picture = Canvas(height, width, _BACK)
        for place, (metric, name, unit, colour) in enumerate(BARS):
            value, top = row[metric], round(height * (0.12 + 0.44 * place))
            if value is not None:
                long = max(1, round((width - 16) * max(0.0, value) / most[metric]))
                picture.paste(np.full((height // 8, long, 3), colour, np.uint8), 8, top + 24)
            text = f"{name} " + ("-" if value is None else f"{value:.2f} {unit}" if unit else f"{value:.3f}")
            picture.write(text, 8, top + 16)
        pictures.append(picture.draw())
    return pictures
