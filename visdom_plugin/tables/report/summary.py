"""Averages of runs, cell by cell: views per scene (run.json has that mean), then scenes, then seeds.

A cell is one row, one column, one number of views (or "mean" over them) and one measure. Sums are exact
(`math.fsum`), so that the order of jobs, scenes and seeds leaves no trace.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from visdom_plugin.tables.measures import MEASURES, Measure, find_measure
from visdom_plugin.tables.paper import find_number, load_numbers
from visdom_plugin.tables.report.layout import MEAN, Layout, read_layout
from visdom_plugin.tables.results import Job, Outcome, Results

_WORST_FIRST = ("not available", "no data", "failed", "running", "waiting", "not measured", "finished")


@dataclass(frozen=True)
class SceneValue:
    """One measure of one job."""

    row: int
    column: int
    views: int
    scene: str
    seed: int
    measure: str
    value: float | None
    status: str
    """As the job's, or "not measured" where a finished run has no such number."""
    error: str | None
    job: Job | None
    """None where the driver has none for this place."""


@dataclass(frozen=True)
class Cell:
    """One number of the table."""

    row: int
    column: int
    views: int | str
    measure: str
    n: int
    """Jobs that gave a number."""
    of: int
    """Jobs that belong to the cell."""
    mean: float | None
    """Over the jobs that gave a number; None where none did."""
    std: float | None
    """Sample standard deviation over seeds; None for fewer than two of them and for cells that are not whole."""
    seeds: tuple[tuple[int, float], ...]
    """Each seed's mean over scenes."""
    paper: float | None
    difference: float | None
    """Ours minus the paper's, of whole cells."""
    status: str
    """"finished" when whole; else the worst of its jobs'."""
    rank: int | None = None
    """1 best, 2 second best of what it is compared with; ties share a rank, as in sport."""

    @property
    def whole(self) -> bool:
        """Whether every job gave its number."""
        return self.n == self.of and self.n > 0


@dataclass(frozen=True)
class Summary:
    """A table's numbers, in the order of rows, columns, views and measures."""

    cells: tuple[Cell, ...]
    scenes: tuple[SceneValue, ...]
    outcomes: tuple[tuple[Job, Outcome], ...]
    layout: Layout

    def cell(self, row: int, column: int, views: int | str, measure: str) -> Cell:
        """The cell of a place."""
        return self._places[row, column, views, measure]

    @cached_property
    def _places(self) -> dict[tuple, Cell]:
        return {(c.row, c.column, c.views, c.measure): c for c in self.cells}


def summarise(results: Results) -> Summary:
    """All cells of a table.

    Raises:
        ConfigError: for an unknown metric, and for a place in the paper that it does not have.
    """
    spec, layout = results.spec, read_layout(results.spec)
    measures = [find_measure(name, spec.source or spec.name) for name in spec.metrics]
    numbers = load_numbers(spec.paper) if spec.paper else None
    if numbers is not None:
        entries = [(row.paper, row.label) for row in spec.rows]
        entries += [(column.paper, column.label) for column in spec.columns]
        for place, label in entries:
            numbers.check(place, f"{spec.source or spec.name}, {label!r}")
    jobs = {
        (job.row, job.column, job.views, job.scene, job.seed): (job, outcome)
        for job, outcome in results.outcomes.items()
    }
    cells, scenes = [], []
    for r, row in enumerate(spec.rows):
        for c, column in enumerate(spec.columns):
            for measure in measures:
                parts = []
                for views in column.views:
                    values = list(_values_of(jobs, (r, c, views), column.scenes, spec.seeds, measure))
                    scenes += values
                    number = find_number(numbers, row.paper, column.paper, views, measure.paper)
                    parts.append(_average(values, r, c, views, measure, number))
                cells += parts
                if len(parts) > 1 and layout.mean:
                    number = find_number(numbers, row.paper, column.paper, MEAN, measure.paper)
                    cells.append(_average_views(parts, number))
    if layout.best != "none":
        groups = [row.group if layout.best == "group" else "" for row in spec.rows]
        cells = rank_cells(cells, groups)
    return Summary(tuple(cells), tuple(scenes), tuple(jobs[key] for key in sorted(jobs)), layout)


def rank_cells(cells: Sequence[Cell], groups: Sequence[str]) -> list[Cell]:
    """The same cells with ranks: whole ones, of the same column, views, measure and group of rows.

    Compared is what is printed, so that two numbers that look the same rank the same. Where all are the same,
    or there is one alone, there are no ranks.

    Args:
        groups: by row.
    """
    contests: dict[tuple, list[Cell]] = defaultdict(list)
    for cell in cells:
        if cell.whole:
            contests[_contest(cell, groups)].append(cell)
    ranked = []
    for cell in cells:
        rivals = contests[_contest(cell, groups)]
        if cell.whole and len({_printed(c) for c in rivals}) > 1:
            better = sum(_is_better(_printed(c), _printed(cell), cell.measure) for c in rivals)
            cell = replace(cell, rank=1 + better)
        ranked.append(cell)
    return ranked


def sample_std(values: Sequence[float]) -> float | None:
    """Standard deviation with n - 1; None for fewer than two values."""
    if len(values) < 2:
        return None
    centre = _mean(values)
    return math.sqrt(math.fsum((v - centre) ** 2 for v in values) / (len(values) - 1))


def _contest(cell: Cell, groups: Sequence[str]) -> tuple:
    return cell.column, cell.views, cell.measure, groups[cell.row]


def _printed(cell: Cell) -> float:
    return round(math.nan if cell.mean is None else cell.mean, MEASURES[cell.measure].digits)


def _is_better(x: float, y: float, measure: str) -> bool:
    return x > y if MEASURES[measure].higher_is_better else x < y


def _values_of(jobs, place, scenes, seeds, measure: Measure) -> Iterable[SceneValue]:
    wanted = [(scene, seed) for scene in scenes for seed in seeds]
    for scene, seed in wanted:
        job, outcome = jobs.get((*place, scene, seed), (None, None))
        status, error, value = "waiting", None, None
        if outcome is not None:
            status, error = outcome.status, outcome.error
            value = measure.read(outcome.record) if status == "finished" else None
        if status == "finished" and value is None:
            status = "not measured"
        row, column, views = place
        yield SceneValue(row, column, views, scene, seed, measure.name, value, status, error, job)


def _average(values: list[SceneValue], r: int, c: int, views, measure: Measure, paper: float | None) -> Cell:
    by_seed: dict[int, list[float]] = {}
    for v in values:
        if v.value is not None:
            by_seed.setdefault(v.seed, []).append(v.value)
    seeds = tuple((seed, _mean(found)) for seed, found in sorted(by_seed.items()))
    n = sum(map(len, by_seed.values()))
    return _close(r, c, views, measure.name, n, len(values), seeds, paper, [v.status for v in values])


def _average_views(parts: list[Cell], paper: float | None) -> Cell:
    """The mean over numbers of views, seed by seed; seeds that a number of views lacks count for nothing."""
    first = parts[0]
    by_seed = [dict(p.seeds) for p in parts]
    common = sorted(set.intersection(*map(set, by_seed)))
    seeds = tuple((seed, _mean([part[seed] for part in by_seed])) for seed in common)
    n, of = sum(p.n for p in parts), sum(p.of for p in parts)
    return _close(
        first.row, first.column, MEAN, first.measure, n, of, seeds, paper, [p.status for p in parts]
    )


def _close(r, c, views, measure, n, of, seeds, paper, statuses) -> Cell:
    means = [mean for _, mean in seeds]
    mean = _mean(means) if means else None
    whole = n == of and n > 0
    status = min(statuses, key=_WORST_FIRST.index) if statuses else "waiting"
    return Cell(
        row=r,
        column=c,
        views=views,
        measure=measure,
        n=n,
        of=of,
        mean=mean,
        std=sample_std(means) if whole else None,
        seeds=seeds,
        paper=paper,
        difference=mean - paper if whole and paper is not None else None,
        status=status,
    )


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)
