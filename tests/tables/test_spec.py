from __future__ import annotations

import pytest
import yaml

from tests.tables.matrix import table
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.spec import Column, flatten, load_table, nest, parse_table

CONTENT = {
    "title": "Small",
    "seeds": [0, 1],
    "settings": {"steps": 5, "hull": {"k": 2}},
    "rows": [
        {"label": "One", "method": "one", "settings": {"hull.k": 4}},
        {"label": "Two", "method": "two", "paper": {"method": "Two", "variant": "vd"}},
    ],
    "columns": [{"label": "real", "root": "mip", "scenes": ["kitchen", "bonsai"], "views": [4, 6]}],
    "editions": {
        "smoke": {"seeds": 3, "columns": [{"label": "drawn"}], "rows": {"Two": {"settings": {"steps": 1}}}},
        "half": {"rows": {"One": None}, "settings": {"hull": {"k": 7}}},
    },
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(CONTENT, sort_keys=False))
    return path


def test_a_rows_own_settings_win_over_the_tables_and_nesting_is_the_same_as_dots(file):
    spec = load_table(file)
    assert spec.rows[0].settings == {"steps": 5, "hull.k": 4}
    assert spec.rows[1].settings == {"steps": 5, "hull.k": 2}
    assert (spec.name, spec.columns[0].scenes, spec.columns[0].views) == (
        "small",
        ("kitchen", "bonsai"),
        (4, 6),
    )


def test_an_edition_is_the_table_with_its_entries_put_in(file):
    smoke = load_table(f"{file}:smoke")
    assert smoke == load_table(file, "smoke")
    assert (smoke.seeds, smoke.columns, smoke.edition) == ((3,), (Column("drawn"),), "smoke")
    assert smoke.rows[1].settings == {"steps": 1, "hull.k": 2} and smoke.rows[0] == load_table(file).rows[0]
    half = load_table(file, "half")
    assert [row.label for row in half.rows] == ["Two"] and half.rows[0].settings["hull.k"] == 7


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mtrics": ["psnr"]}, "did you mean 'metrics'"),
        ({"rows": [{"label": "a", "method": "b", "settngs": {}}]}, "did you mean 'settings'"),
        ({"columns": [{"label": "a", "vews": 4}]}, "did you mean 'views'"),
        ({"columns": [{"label": "a", "views": ["four"]}]}, "views"),
        ({"columns": [{"label": "a", "views": [0]}]}, "1 or more"),
        ({"columns": [{"label": "a", "downscale": 0.5}]}, "1 or more"),
        ({"columns": [{"label": "a", "downscale": float("inf")}]}, "1 or more"),
        ({"columns": [{"label": "a", "views": [4, 4, 6]}]}, "views of column 'a'"),
        ({"columns": [{"label": "a", "root": "r", "scenes": ["b", "./b"]}]}, "scenes of column 'a'"),
        ({"columns": [{"label": "a", "root": "r", "scenes": []}]}, "scenes of column 'a'"),
        ({"columns": [{"label": "a", "paper": "Omni3D"}]}, "columns[0].paper cannot be 'Omni3D'"),
        ({"rows": [{"label": "a", "method": "b", "paper": "INGP"}]}, "give a mapping"),
        ({"layout": True}, "layout cannot be True"),
        ({"name": "../../elsewhere"}, "cannot be called '../../elsewhere'"),
        ({"name": ".."}, "cannot be called"),
        ({"name": ""}, "cannot be called"),
        ({"columns": []}, "no columns"),
        ({"rows": [{"label": "a"}]}, "no method"),
        ({"rows": [{"label": "a", "method": "b"}] * 2}, "two rows have the label 'a'"),
        ({"rows": "all"}, "must be a list"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "seeds"),
        ({"varies": ["hul"]}, "varies"),
        ({"budget": "quik"}, "did you mean 'quick'"),
        ({"kind": "tree"}, "kind"),
    ],
)
def test_what_is_wrong_in_a_table_is_named(change, said):
    with pytest.raises(ConfigError, match=r"small\.yaml") as caught:
        table(**change) if "rows" not in change else parse_table(
            {"columns": [{"label": "c"}], **change}, "small", "small.yaml"
        )
    assert said in str(caught.value)


def test_editions_and_the_rows_that_they_change_may_have_numbers_for_names(tmp_path):
    file = tmp_path / "numbers.yaml"
    file.write_text(
        "rows: [{label: '7', method: a}]\ncolumns: [{label: c}]\neditions: {1: {rows: {7: {method: b}}}}"
    )
    assert list(load_table(file).editions) == ["1"] and load_table(f"{file}:1").rows[0].method == "b"
    with pytest.raises(ConfigError, match="editions there: 1"):
        load_table(file, "2")


@pytest.mark.parametrize("row", ["all", {"label": ["One"], "method": "one"}, {"method": "one"}])
def test_an_edition_that_changes_rows_names_the_row_that_is_none(tmp_path, row):
    file = tmp_path / "bad.yaml"
    rows = [*CONTENT["rows"], row]
    file.write_text(yaml.safe_dump(CONTENT | {"rows": rows}))
    with pytest.raises(ConfigError, match=r"rows\[2\]"):
        load_table(file, "half" if row == "all" else None)
    with pytest.raises(ConfigError, match=r"rows\["):
        load_table(file, "half")


def test_an_edition_keeps_its_folder_beside_the_others(file):
    file.write_text(yaml.safe_dump(CONTENT | {"editions": {"x/../../y": {}}}))
    with pytest.raises(ConfigError, match="without slashes"):
        load_table(file, "x/../../y")
    assert load_table(file).folder_name == "small"


def test_files_and_editions_that_are_not_there_are_named(file, tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'smoke'"):
        load_table(file, "smok")
    with pytest.raises(ConfigError, match="no table"):
        load_table(tmp_path / "other.yaml")
    with pytest.raises(ConfigError, match="two editions"):
        load_table(f"{file}:smoke", "half")
    for text in ("[1, 2]", "a: [", "\x00", "a: 2026-13-32"):
        file.write_text(text)
        with pytest.raises(ConfigError, match=r"small\.yaml"):
            load_table(file)


@pytest.mark.parametrize("paths", [["hull", "hull.k"], ["hull.k", "hull"]])
def test_a_setting_and_what_is_inside_it_do_not_go_together(paths):
    with pytest.raises(ConfigError, match="settings name both"):
        nest(dict.fromkeys(paths, 3), "row 'a'")


def test_nested_settings_are_flat_again():
    flat = {"steps": 3, "hull.k": 2, "hull.bounds.lower": [0, 0, 0], "vd.missing": None}
    assert flatten(nest(flat, "row 'a'")) == flat
