"""Cells of a table: a slow twin, and what the order of things must not change."""

import random
import statistics
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tables.report.made_up import make_results, make_spec, tables
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.report.labels import describe_numbers
from visdom_plugin.tables.report.layout import MEAN
from visdom_plugin.tables.report.summary import Cell, rank_cells, sample_std, summarise
from visdom_plugin.tables.results import Job, Outcome, Results


def slow_numbers(results, row, column, views, name):
    """(n, of, {seed: mean over scenes}) of one cell, the obvious way."""
    n, of, seeds = 0, 0, {}
    for seed in results.spec.seeds:
        values = []
        for job, outcome in results.select(row, column, views):
            if job.seed == seed:
                of += 1
                value = outcome.record["metrics"]["test"][name] if outcome.status == "finished" else None
                if value is not None:
                    values.append(value)
        n += len(values)
        if values:
            seeds[seed] = sum(values) / len(values)
    return n, of, seeds


@settings(max_examples=20, deadline=None)
@given(tables())
def test_cells_equal_their_slow_twin(results):
    for cell in summarise(results).cells:
        views = results.spec.columns[cell.column].views if cell.views == MEAN else [cell.views]
        parts = [slow_numbers(results, cell.row, cell.column, v, cell.measure) for v in views]
        assert cell.n == sum(p[0] for p in parts) and cell.of == sum(p[1] for p in parts)
        common = [s for s in results.spec.seeds if all(s in p[2] for p in parts)]
        means = [statistics.fmean(p[2][s] for p in parts) for s in common]
        assert [s for s, _ in cell.seeds] == common
        if not means:
            assert cell.mean is None and cell.difference is None
            continue
        assert cell.mean == pytest.approx(statistics.fmean(means), rel=1e-12)
        if cell.n < cell.of:
            assert cell.std is None and cell.difference is None and cell.rank is None
            assert cell.status != "finished"
        else:
            assert cell.status == "finished"
            expected = statistics.stdev(means) if len(means) > 1 else None
            assert (cell.std is None) == (expected is None)
            if expected is not None:
                assert cell.std == pytest.approx(expected, rel=1e-9, abs=1e-9)
            if cell.paper is not None:
                assert cell.difference == cell.mean - cell.paper


@settings(max_examples=20, deadline=None)
@given(tables(), st.integers(0, 10**6))
def test_the_order_of_jobs_changes_nothing(results, seed):
    pairs = list(results.outcomes.items())
    random.Random(seed).shuffle(pairs)
    assert summarise(replace(results, outcomes=dict(pairs))) == summarise(results)


@settings(max_examples=20, deadline=None)
@given(tables(), st.integers(0, 10**6))
def test_the_order_of_rows_scenes_and_seeds_changes_only_the_order_of_cells(results, seed):
    draw, spec = random.Random(seed), results.spec
    order = draw.sample(range(len(spec.rows)), len(spec.rows))
    moved = replace(
        spec,
        rows=tuple(spec.rows[i] for i in order),
        columns=tuple(replace(c, scenes=tuple(draw.sample(c.scenes, len(c.scenes)))) for c in spec.columns),
        seeds=tuple(draw.sample(spec.seeds, len(spec.seeds))),
    )
    outcomes = {replace(job, row=order.index(job.row)): o for job, o in results.outcomes.items()}
    before = {(c.row, c.column, c.views, c.measure): c for c in summarise(results).cells}
    after = summarise(Results(moved, outcomes)).cells
    assert len(after) == len(before)
    for cell in after:
        old = before[order[cell.row], cell.column, cell.views, cell.measure]
        assert replace(cell, row=old.row) == old


@settings(max_examples=20, deadline=None)
@given(tables())
def test_ranks_count_the_rows_that_print_something_better(results):
    summary = summarise(results)
    by_group = results.spec.layout["best"] == "group"
    for cell in summary.cells:
        measure = MEASURES[cell.measure]
        rivals = [
            round(c.mean, measure.digits)
            for c in summary.cells
            if (c.column, c.views, c.measure) == (cell.column, cell.views, cell.measure)
            and c.n == c.of
            and (not by_group or results.spec.rows[c.row].group == results.spec.rows[cell.row].group)
        ]
        if cell.n < cell.of or len(set(rivals)) == 1:
            assert cell.rank is None
            continue
        order = sorted(rivals, reverse=measure.higher_is_better)
        assert cell.rank == 1 + order.index(round(cell.mean, measure.digits))


def cell_of(row, mean, measure="psnr", n=1):
    return Cell(row, 0, 4, measure, n, 1, mean, None, ((0, mean),), None, None, "finished")


@pytest.mark.parametrize(
    ("measure", "means", "ranks"),
    [
        ("psnr", [20, 22, 21], [3, 1, 2]),
        ("lpips", [20, 22, 21], [1, 3, 2]),
        ("psnr", [22.001, 22.004, 21], [1, 1, 3]),
        ("psnr", [22, 21, 21, 20], [1, 2, 2, 4]),
        ("train_min", [2.0, 10.0, 10.0], [1, 2, 2]),
        ("psnr", [20.001, 20.0, 20.003], [None, None, None]),
    ],
)
def test_ties_share_a_rank(measure, means, ranks):
    cells = [cell_of(r, mean, measure) for r, mean in enumerate(means)]
    assert [c.rank for c in rank_cells(cells, [""] * len(cells))] == ranks


def test_groups_are_compared_within_themselves_and_unfinished_cells_with_nothing():
    cells = [cell_of(0, 20), cell_of(1, 30), cell_of(2, 25), cell_of(3, 99, n=0)]
    assert [c.rank for c in rank_cells(cells, ["a", "b", "a", "a"])] == [2, None, 1, None]


@settings(deadline=None)
@given(st.floats(-1e6, 1e6))
def test_one_value_has_no_spread(value):
    assert sample_std([value]) is None and sample_std([]) is None
    assert sample_std([value, value, value]) == pytest.approx(0, abs=1e-9)


def test_a_table_of_one_seed_has_no_spread():
    results = make_results(make_spec(seeds=(7,)))
    assert all(c.std is None and c.whole for c in summarise(results).cells)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=6), st.floats(-100, 100), st.floats(-10, 10))
def test_spread_ignores_shifts_and_follows_scale(values, shift, scale):
    spread = sample_std(values)
    assert sample_std([v + shift for v in values]) == pytest.approx(spread, abs=1e-9, rel=1e-9)
    assert sample_std([v * scale for v in values]) == pytest.approx(abs(scale) * spread, abs=1e-9, rel=1e-9)


def test_jobs_that_the_driver_does_not_list_count_as_not_run():
    results = make_results(make_spec())
    fewer = dict(list(results.outcomes.items())[1:])
    cell = summarise(Results(results.spec, fewer)).cell(0, 0, 4, "psnr")
    assert (cell.n, cell.of, cell.status) == (5, 6, "waiting")


def test_a_method_that_is_not_there_has_the_papers_number_beside_it_and_none_of_ours():
    spec = make_spec(columns=1, seeds=(0,), views=(4,))
    outcomes = dict(make_results(spec).outcomes)
    for job in outcomes:
        if job.row == 1:
            outcomes[job] = Outcome("not available")
    cell = summarise(Results(spec, outcomes)).cell(1, 0, 4, "psnr")
    assert (cell.mean, cell.difference, cell.status, cell.paper) == (None, None, "not available", 24.10)


def test_a_number_that_a_finished_run_lacks_is_not_measured():
    spec = make_spec(rows=2, columns=1, scenes=1, views=(4,), seeds=(0,), metrics=("lpips",), paper=None)
    outcomes = {Job(r, 0, "scene00", 4, 0): Outcome("finished", {"metrics": {"test": {}}}) for r in (0, 1)}
    cell = summarise(Results(spec, outcomes)).cells[0]
    assert (cell.n, cell.of, cell.status) == (0, 1, "not measured")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"metrics": ("psrn",)}, "did you mean 'psnr'"),
        ({"layout": {"best": "row"}}, "layout.best cannot be 'row'"),
        ({"layout": {"bets": "column"}}, "unknown setting 'layout.bets'"),
        ({"paper": "main"}, "did you mean 'main_sota'"),
    ],
)
def test_faults_of_the_table_file_are_named(change, said):
    with pytest.raises(ConfigError, match=said):
        summarise(make_results(replace(make_spec(), **change)))


def test_what_the_project_page_prints_otherwise_is_said_below_the_table():
    spec = make_spec(rows=["K = 3", "K = 2"], columns=1, paper="ablation_k", metrics=("psnr",))
    rows = [
        replace(row, paper={"method": "ZipNeRF", "variant": f"vd_K{k}"})
        for row, k in zip(spec.rows, (3, 2), strict=True)
    ]
    spec = replace(spec, rows=tuple(rows))
    said = [line for line in describe_numbers(spec, summarise(make_results(spec))) if "project page" in line]
    places = "K = 3, data 0, 4 views: 24.10; K = 3, data 0, mean: 25.99"
    assert said == [f"The paper's project page prints other numbers: {places}."]
