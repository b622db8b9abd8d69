"""Averages of runs, cell by cell: views per scene (run.json has that mean), then scenes, then seeds.

A cell is one row, one column, one number of views (or "mean" over them) and one measure. Sums are exact
(`math.fsum`), so that the order of jobs, scenes and seeds leaves no trace.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

from visdom_plugin.tables.measures import MEASURES, Measure, find_measure
from visdom_plugin.tables.paper import find_number, load_numbers
from visdom_plugin.tables.report.layout import MEAN, Layout, read_layout
from visdom_plugin.tables.results import Job, Outcome, Results

Place = tuple[int, int, int | str, str]
"""Row, column, number of views or "mean", and measure."""
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
    value: float | None = None
    status: str = "waiting"
    """As the job's, or "not measured" where a finished run has no such number."""
    error: str | None = None
    job: Job | None = None
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
    for (r, row), (c, column), measure in product(enumerate(spec.rows), enumerate(spec.columns), measures):
        paper = partial(find_number, numbers, row.paper, column.paper, metric=measure.paper)
        parts = []
        for views in column.views:
            values = []
            for scene, seed in product(column.scenes, spec.seeds):
                value = SceneValue(r, c, views, scene, seed, measure.name)
                values.append(_read(value, jobs.get((r, c, views, scene, seed)), measure))
            scenes += values
            parts.append(_average((r, c, views, measure.name), values, paper(views)))
        cells += parts
        if len(parts) > 1 and layout.mean:
            cells.append(_average_views((r, c, MEAN, measure.name), parts, paper(MEAN)))
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


def _read(place: SceneValue, found: tuple[Job, Outcome] | None, measure: Measure) -> SceneValue:
    if found is None:
        return place
    job, outcome = found
    finished = outcome.status == "finished"
    value = measure.read(outcome.record) if finished else None
    status = "not measured" if finished and value is None else outcome.status
    return replace(place, value=value, status=status, error=outcome.error, job=job)


def _average(place: Place, values: list[SceneValue], paper: float | None) -> Cell:
    by_seed: dict[int, list[float]] = {}
    for v in values:
        if v.value is not None:
            by_seed.setdefault(v.seed, []).append(v.value)
    seeds = {seed: _mean(found) for seed, found in sorted(by_seed.items())}
    n = sum(map(len, by_seed.values()))
    return _close(place, n, len(values), seeds, paper, [v.status for v in values])


def _average_views(place: Place, parts: list[Cell], paper: float | None) -> Cell:
    """The mean over numbers of views, seed by seed; seeds that a number of views lacks count for nothing."""
    by_seed = [dict(p.seeds) for p in parts]
    common = sorted(set.intersection(*map(set, by_seed)))
    seeds = {seed: _mean([part[seed] for part in by_seed]) for seed in common}
    n, of = sum(p.n for p in parts), sum(p.of for p in parts)
    return _close(place, n, of, seeds, paper, [p.status for p in parts])


def _close(
    place: Place, n: int, of: int, seeds: dict[int, float], paper: float | None, statuses: Sequence[str]
) -> Cell:
    means = list(seeds.values())
    mean, whole = _mean(means) if means else None, n == of and n > 0
    std = sample_std(means) if whole else None
    difference = None if mean is None or paper is None or not whole else mean - paper
    status = min(statuses, key=_WORST_FIRST.index) if statuses else "waiting"
    return Cell(*place, n, of, mean, std, tuple(seeds.items()), paper, difference, status)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)
