"""Words, figures and pictures of a table's HTML page; `table.html` lays them out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.report.layout import spell_views
from visdom_plugin.tables.report.printed import describe_table, make_environment
from visdom_plugin.tables.report.strips import ERROR_FULL, data_uri, read_strip
from visdom_plugin.tables.report.summary import SceneValue, Summary
from visdom_plugin.tables.report.svg_figures import (
    Dots,
    average_curves,
    draw_curves,
    draw_spread,
    pen,
    read_curve,
)
from visdom_plugin.tables.results import Job, Outcome
from visdom_plugin.tables.spec import TableSpec

if TYPE_CHECKING:
    from jinja2 import Template

HEIGHT_PX, MANY_HEIGHT_PX = 160, 96
"""Height of pictures, and where there are many of them."""
MANY = 30
OPEN = 4
"""More places (column and number of views) than this, and their details start closed."""

Finished = tuple[Job, Path, Outcome]
"""A job, its run directory, and what came of it."""


def to_html(spec: TableSpec, summary: Summary) -> str:
    """The page."""
    numbers = [(c, v) for c in range(len(spec.columns)) for v in spec.columns[c].views]
    many = len(numbers) * len(spec.rows) > MANY
    places = [_place(spec, summary, c, views, MANY_HEIGHT_PX if many else HEIGHT_PX) for c, views in numbers]
    return _template().render(
        describe_table(spec, summary),
        places=[
            place for place in places if any(place[k] for k in ("spreads", "curves", "strips", "scenes"))
        ],
        unfolded=len(numbers) <= OPEN,
        error_full=ERROR_FULL,
    )


@lru_cache(maxsize=1)
def _template() -> Template:
    return make_environment().get_template("table.html")


def _place(spec: TableSpec, summary: Summary, c: int, views: int, height_px: int) -> dict[str, object]:
    """Everything behind one column and number of views; parts that have nothing to show are empty."""
    place: dict[str, object] = {
        "title": f"{spec.columns[c].label}, {spell_views(views)}",
        "spreads": [s for m in spec.metrics if (s := _spread(spec, summary, c, views, m))],
        "curves": "",
        "strips": [],
        "heads": spec.columns[c].scenes,
        "scenes": [],
    }
    if summary.layout.pictures:
        jobs = [(j, o) for j, o in summary.outcomes if (j.column, j.views) == (c, views)]
        done = [list(_finished(jobs, r)) for r in range(len(spec.rows))]
        place["curves"], place["legend"] = _curves(spec, done)
        place["strips"] = _strips(spec, c, done, height_px)
    if len(spec.columns[c].scenes) * len(spec.seeds) > 1:
        place["scenes"] = [t for m in spec.metrics if (t := _scenes(spec, summary, c, views, m))]
    return place


def _spread(spec: TableSpec, summary: Summary, c: int, views: int, measure: str) -> tuple[str, str] | None:
    """Title and SVG; None without any number."""
    rows = []
    for r, row in enumerate(spec.rows):
        cell = summary.cell(r, c, views, measure)
        if cell.mean is not None:
            rows.append(Dots(row.label, tuple(value for _, value in cell.seeds), cell.mean, cell.paper))
    if not rows:
        return None
    paper = ", paper (diamond)" if any(dots.paper is not None for dots in rows) else ""
    title = f"{MEASURES[measure].title}: seeds (dots), mean (bar){paper}"
    return title, draw_spread(tuple(rows), MEASURES[measure])


def _curves(spec: TableSpec, done: Sequence[Sequence[Finished]]) -> tuple[str, list[tuple[str, str, str]]]:
    """SVG, and colour, dashes and label of each line; empty where no run has a log."""
    found = [[x for _, run_dir, _ in runs if (x := read_curve(run_dir)) is not None] for runs in done]
    series = [(r, spec.rows[r].label, average_curves(curves)) for r, curves in enumerate(found) if curves]
    return draw_curves(series) if series else "", [(*pen(r), label) for r, label, _ in series]


def _strips(spec: TableSpec, c: int, done: Sequence[Sequence[Finished]], height_px: int) -> list[tuple]:
    """A strip per row, of the first scene and seed that it has: label, words, view, named pictures."""
    order = {scene: i for i, scene in enumerate(spec.columns[c].scenes)}
    strips: list[tuple] = []
    for row, runs in zip(spec.rows, done, strict=True):
        if not runs:
            continue
        job, run_dir, outcome = min(runs, key=lambda run: (order.get(run[0].scene, len(order)), run[0].seed))
        strip = read_strip(run_dir, outcome.record or {}, height_px)
        if strip is not None:
            words = f"{job.scene}, seed {job.seed}, view {strip.view}"
            words += "" if strip.psnr is None else f", {strip.psnr:.2f} dB"
            pictures = [(what, data_uri(getattr(strip, what))) for what in ("truth", "render", "error")]
            strips.append((row.label, words, strip.view, pictures))
    return strips


def _scenes(
    spec: TableSpec, summary: Summary, c: int, views: int, measure: str
) -> tuple[str, list[tuple[str, list[tuple[str, str]]]]] | None:
    """Title and rows by scenes: the mean over seeds, and each seed's value; None where there is no number."""
    values: dict[tuple[int, str], list[SceneValue]] = {}
    for v in summary.scenes:
        if (v.column, v.views, v.measure) == (c, views, measure):
            values.setdefault((v.row, v.scene), []).append(v)
    if all(v.value is None for found in values.values() for v in found):
        return None
    rows = []
    for r, row in enumerate(spec.rows):
        cells = [_scene_cell(values.get((r, scene), []), measure) for scene in spec.columns[c].scenes]
        rows.append((row.label, cells))
    return MEASURES[measure].title, rows


def _scene_cell(found: list[SceneValue], measure: str) -> tuple[str, str]:
    spell = MEASURES[measure].spell
    numbers = [v.value for v in found if v.value is not None]
    if not numbers:
        return (found[0].status.replace("waiting", "not run") if found else ""), ""
    each = [spell(v.value) if v.value is not None else v.status for v in found] if len(found) > 1 else []
    return spell(sum(numbers) / len(numbers)), ", ".join(each)


def _finished(jobs: list[tuple[Job, Outcome]], row: int) -> Iterator[Finished]:
    for job, outcome in jobs:
        if job.row == row and outcome.status == "finished" and job.run_dir is not None:
            yield job, job.run_dir, outcome
