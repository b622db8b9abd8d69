from __future__ import annotations

from dataclasses import replace

import pytest

from tests.tables.matrix import make, table
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.protocol import check_records
from visdom_plugin.tables.results import Outcome, Results

VD = "three+vd"


def _rows(first, second):
    return [{"label": "First", "method": VD} | first, {"label": "Second", "method": VD} | second]


@pytest.mark.parametrize(
    ("fact", "values", "changes"),
    [
        ("hull.k", ("3", "2"), {"rows": _rows({}, {"settings": {"hull.k": 2}})}),
        (
            "hull.kind",
            ("'visdom'", "'unit-sphere'"),
            {"rows": _rows({}, {"settings": {"hull.kind": "unit-sphere"}})},
        ),
        ("budget", ("'quick'", "'full'"), {"rows": _rows({}, {"budget": "full"})}),
        ("downscale", ("1.0", "4.0"), {"columns": [{"label": "First"}, {"label": "Second", "downscale": 4}]}),
    ],
)
def test_mixed_settings_are_refused_by_name_unless_told(tmp_path, fact, values, changes):
    with pytest.raises(ConfigError) as caught:
        make(tmp_path, table(**changes))
    text = str(caught.value)
    assert all(word in text for word in (fact, *values, "'First'", "'Second'", f"varies: [{fact}]"))
    others = [f for f in ("hull.k", "hull.kind", "budget", "downscale") if f != fact]
    with pytest.raises(ConfigError, match=fact):
        make(tmp_path, table(**changes, varies=others))
    assert make(tmp_path, table(**changes, varies=[fact])).tasks


def test_the_hull_of_a_row_that_is_not_confined_to_it_counts_for_nothing(tmp_path):
    rows = [{"label": "Bare", "method": "one", "settings": {"hull.k": 1}}, {"label": "VD", "method": VD}]
    assert make(tmp_path, table(rows)).tasks
    with pytest.raises(ConfigError, match=r"hull\.k"):
        make(tmp_path, table(rows, kind="hull"))
    # Without K in its rule, a hull has none.
    rows = _rows({}, {"settings": {"hull.kind": "traditional", "hull.k": 1}})
    assert make(tmp_path, table(rows, varies=["hull.kind"])).tasks


def _record(**changes):
    record = {
        "schema": 1,
        "data": {"train": ["a"], "test": ["b"], "downscale": 1},
        "metrics": {"protocol": {"background": "white", "definition": 1}},
    }
    return record | changes


@pytest.mark.parametrize(
    ("fact", "record"),
    [
        ("schema", _record(schema=2)),
        ("evaluation.background", _record(metrics={"protocol": {"background": "black", "definition": 1}})),
        ("metrics.definition", _record(metrics={"protocol": {"background": "white"}})),
        ("views", _record(data={"train": ["a"], "test": ["c"], "downscale": 1})),
    ],
)
def test_mixed_records_are_refused_by_name_unless_told(tmp_path, fact, record):
    made = make(tmp_path)
    outcomes = {job: Outcome("finished", _record()) for job in made.jobs}
    check_records(Results(made.spec, outcomes))
    outcomes[list(outcomes)[2]] = Outcome("finished", record)
    with pytest.raises(ConfigError, match=fact) as caught:
        check_records(Results(made.spec, outcomes))
    assert "'One'" in str(caught.value) and "'Two'" in str(caught.value)
    check_records(Results(replace(made.spec, varies=(fact,)), outcomes))
