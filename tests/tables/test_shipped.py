"""The shipped tables: their settings and places in the paper exist, and no number of the paper is left out."""

from dataclasses import replace

import pytest

from visdom_plugin.cli.table_parts.workshop import list_not_built, make_workshop
from visdom_plugin.tables.measures import find_measure
from visdom_plugin.tables.paper import find_number, load_numbers
from visdom_plugin.tables.report.layout import list_views, read_layout
from visdom_plugin.tables.report.summary import summarise
from visdom_plugin.tables.report.write import write_all
from visdom_plugin.tables.results import Results
from visdom_plugin.tables.run.jobs import plan
from visdom_plugin.tables.spec import list_tables, load_table

NEED_WEIGHTS = {"gaussianobject", "gaussianobject+vd"}
"""Not available where the networks that they take are not."""
EDITIONS = [(name, edition) for name in list_tables() for edition in (None, *load_table(name).editions)]


def test_the_nine_tables_are_there_each_with_a_small_edition():
    assert set(list_tables()) == {
        "general_purpose",
        "hull_chamfer",
        "hull_variants_nerf",
        "k_ablation",
        "lpips",
        "main",
        "mask_dilation",
        "train_times",
        "vaxnerf",
    }
    assert {name for name, edition in EDITIONS if edition == "smoke"} == set(list_tables())


@pytest.mark.parametrize(("name", "edition"), EDITIONS)
def test_every_row_resolves_and_protocols_do_not_mix(name, edition, tmp_path):
    spec = load_table(name, edition)
    made = plan(spec, tmp_path, make_workshop("cpu"))
    missing = {spec.rows[job.row].method for job, o in made.jobs.items() if o.status == "not available"}
    assert missing <= list_not_built() | NEED_WEIGHTS
    if edition == "smoke":
        assert {c.root for c in spec.columns} == {"built-in"} and len(spec.seeds) == 1
        assert len({job.run_dir for job in made.jobs if job.run_dir}) >= len(spec.rows) - len(missing)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "edition"), EDITIONS)
def test_rows_and_columns_name_places_that_the_paper_has(name, edition, tmp_path):
    spec = load_table(name, edition)
    summary = summarise(Results(spec))
    numbers = load_numbers(spec.paper)
    for r, row in enumerate(spec.rows):
        for c, column in enumerate(spec.columns):
            if row.paper is not None and column.paper is not None:
                cells = [x for x in summary.cells if (x.row, x.column) == (r, c)]
                # The paper prints three gains of its sweep of dilations, one of them at 4 views.
                sweep = name == "mask_dilation" and edition
                assert sweep or any(x.paper is not None for x in cells), (row.label, column.label)
                assert all(x.mean is None and x.status == "waiting" for x in cells)
    if edition is None:
        assert any(c.paper is not None for c in summary.cells)
    assert numbers.values and write_all(Results(spec), tmp_path)


@pytest.mark.parametrize("name", list(list_tables()))
def test_every_number_of_the_paper_stands_in_its_table(name):
    spec = load_table(name)
    numbers = load_numbers(spec.paper)
    place = {
        (row.label, column.label, views, metric): find_number(
            numbers, row.paper, column.paper, views, find_measure(metric).paper
        )
        for row in spec.rows
        for c, column in enumerate(spec.columns)
        for views in list_views(spec, c)
        for metric in spec.metrics
    }
    printed = sorted(v for v in place.values() if v is not None)
    expected = dict(numbers.values)
    if name == "mask_dilation":
        gains = {k: v for k, v in expected.items() if k[-1] == "psnr_gain_db"}
        for (dataset, views, method, _, _), gain in gains.items():
            base = expected[dataset, views, method, "vd_dilate_r0", "psnr_db"]
            expected[dataset, views, method, "sum", str(gain)] = base + gain
        expected = {k: v for k, v in expected.items() if k not in gains}
    assert printed == sorted(expected.values())


def test_an_edition_of_the_main_table_has_every_variant_of_every_method():
    rows = {row.method for row in load_table("main", "smoke").rows}
    methods = (
        "ingp",
        "zipnerf-lite",
        "zerorf-lite",
        "3dgs-go",
        "splatfields-lite",
        "fsgs-lite",
        "corgs-lite",
    )
    of_variants = {m + v for m in methods for v in ("", "+mask", "+vd")}
    assert rows == of_variants | {"vaxnerf", "vaxnerf+hull"}
    assert load_table("main", "captures").seeds == (0, 1, 2)


def test_the_papers_layouts_are_kept():
    for name in ("general_purpose", "lpips", "k_ablation", "hull_variants_nerf"):
        assert read_layout(load_table(name)).best == "group"
    main = load_table("main")
    assert read_layout(main).best == "column" and read_layout(main).second
    assert read_layout(replace(main, layout={})).mean is False
