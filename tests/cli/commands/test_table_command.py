from __future__ import annotations

import copy
import datetime
import json
import math
import sys
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from visdom_plugin import registry
from visdom_plugin.cli.commands import table
from visdom_plugin.cli.table_parts import run_table
from visdom_plugin.cli.table_parts.workshop import list_not_built, make_workshop
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.report.write import write_all
from visdom_plugin.tables.results import Results
from visdom_plugin.tables.spec import list_tables, load_table

SMALL = {
    "title": "Two short runs",
    "budget": "quick",
    "settings": {"steps": 2},
    "metrics": ["psnr", "ssim"],
    "rows": [
        {"label": "Bare", "method": "ingp"},
        {"label": "Confined", "method": "ingp+vd", "settings": {"hull.resolution": 32}},
        {"label": "Nobody's", "method": "nobodys-method"},
    ],
    "columns": [{"label": "drawn", "downscale": 4}],
}
EVERYTHING = {
    "name": "full",
    "title": "All that a table may say",
    "kind": "train",
    "budget": "quick",
    "seeds": [0, 1],
    "metrics": ["psnr", "ssim"],
    "varies": ["downscale"],
    "settings": {"steps": 2},
    "notes": ["a note"],
    "paper": "main_sota",
    "layout": {"best": "group", "second": False, "mean": True},
    "slurm": {"cpus": 2, "options": {"reservation": "night"}},
    "rows": [
        {"label": "A", "method": "ingp", "group": "g", "paper": {"method": "INGP", "variant": "vd"}},
        {
            "label": "B",
            "method": "ingp+vd",
            "budget": "quick",
            "settings": {"hull": {"k": 3}, "vd.enabled": True},
        },
    ],
    "columns": [
        {"label": "drawn", "views": [4, 6], "downscale": 4, "paper": {"dataset": "MipNeRF360", "views": 4}},
        {"label": "real", "root": "mip", "scenes": ["kitchen"], "reading": {"frame": 1}},
    ],
    "editions": {"smoke": {"seeds": [0], "rows": {"A": {"settings": {"steps": 1}}, "B": None}}},
}
ODD = (
    None,
    True,
    0,
    3,
    -1.5,
    math.nan,
    math.inf,
    "",
    "x",
    "../x",
    "a\0b",
    "1e3",
    datetime.date(2026, 1, 1),
    b"x",
)
ODD += ([], [1], ["x", {}], [[0]], {}, {1: 2}, {"x": []}, {None: None})


@pytest.fixture
def small(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


def _change(path, **changes):
    path.write_text(yaml.safe_dump(SMALL | changes))


@pytest.mark.slow
def test_two_real_runs_make_a_table_and_are_used_again(small, tmp_path, capsys):
    assert table.main([str(small), "--out", "t"]) == 0
    said = capsys.readouterr()
    assert "Confined" in said.out and "not available" in said.out and "2/2 done" in said.err
    for suffix in ("md", "csv", "tex", "html"):
        assert (tmp_path / f"t/table.{suffix}").stat().st_size > 100
    runs = [json.loads(p.read_text()) for p in sorted((tmp_path / "t/runs").glob("*/run.json"))]
    assert [r["method"] for r in runs] == ["ingp+vd", "ingp"]
    assert runs[0]["config"]["steps"] == 2 and runs[0]["config"]["hull"]["resolution"] == 32
    assert runs[0]["data"]["downscale"] == 4 and runs[0]["metrics"]["protocol"]["background"] == "white"
    assert f"{runs[1]['metrics']['test']['psnr']:.2f}" in (tmp_path / "t/table.md").read_text()
    before = (tmp_path / "t/table.csv").read_bytes()
    stamps = [p.stat().st_mtime_ns for p in sorted((tmp_path / "t/runs").glob("*/run.json"))]
    assert table.main([str(small), "--out", "t", "--quiet", "--workers", "2"]) == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / "t/table.csv").read_bytes() == before
    assert stamps == [p.stat().st_mtime_ns for p in sorted((tmp_path / "t/runs").glob("*/run.json"))]
    assert table.main([str(small), "--out", "t", "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["reuse", "reuse", "not"] and "0 of them" in lines[-1]


@pytest.mark.slow
def test_a_run_that_fails_is_quoted_and_the_command_says_so(small, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert table.main([str(small), "--out", "t", "--data", "empty", "--only", "Bare"]) == run_table.FAILURES
    said = capsys.readouterr()
    assert "failed: Bare, empty, 4 views, seed 0" in said.err and "--retry" in said.err
    (note,) = (tmp_path / "t/runs").glob("*.error.json")
    assert (
        json.loads(note.read_text())["error"].splitlines()[0] in (tmp_path / "t/table_scenes.csv").read_text()
    )


def test_a_dry_run_writes_nothing(small, tmp_path, capsys):
    assert table.main([str(small), "--dry-run", "--seeds", "0", "1", "--views", "4", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "12 jobs, 8 runs, 8 of them not finished"
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["smal.yaml"], "there is no table"),
        (["small.yaml", "--edition", "tiny"], "no edition 'tiny'"),
        (["small.yaml", "--only", "Bear"], "rows: Bare, Confined"),
        (["small.yaml", "--root", "mip"], "NAME=DIR"),
        (["small.yaml", "--workers", "0"], "1 or more"),
        (["small.yaml", "--workers", "2", "--executor", "process"], "does not go with"),
        (["small.yaml", "--data", "nowhere"], "no folder"),
        (["small.yaml", "--out", "small.yaml"], "is a file"),
        (["small.yaml", "--budget", "auto", "--executor", "slurm"], "budget"),
        (["small.yaml", "--out", "small.yaml/t"], "small.yaml is a file"),
        (["small.yaml", "--runs", "small.yaml"], "choose another --runs"),
        (["small.yaml", "--out", "t" * 300], "choose another location"),
        (["small.yaml", "--views", "0"], "1 or more"),
        (["small.yaml", "--views", "4", "4"], "different values, not 4, 4"),
        (["small.yaml", "--downscale", "0"], "1 or more"),
        (["small.yaml", "--downscale", "0.5"], "1 or more"),
        (["small.yaml", "--downscale", "nan"], "1 or more"),
        (["small.yaml", "--downscale", "inf"], "1 or more"),
        (["small.yaml", "--seeds", "0", "0"], "different values, not 0, 0"),
        (["small.yaml", "--root", "mip=."], "no data root 'mip'"),
        (["small.yaml", "--views", "999"], "must be 2 to 16"),
        (["--views", "4"], "no table is named"),
    ],
)
def test_a_users_mistake_ends_with_2_and_runs_nothing(small, tmp_path, capsys, words, said, dry):
    assert table.main([*words, *dry]) == 2
    assert said in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


def test_a_gpu_that_is_not_there_is_said_once_and_before_any_run(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert table.main(["small.yaml", "--device", "cuda"]) == 2
    assert capsys.readouterr().err.count("no CUDA device") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


@pytest.mark.skipif(sys.platform != "linux", reason="a place where nobody can make a folder")
def test_a_folder_that_cannot_be_made_is_said(small, capsys):
    assert table.main([str(small), "--out", "/proc/t"]) == 2
    assert "cannot be made" in capsys.readouterr().err


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rows": [{"label": "Bare", "method": "ingp", "settings": {"stps": 2}}]}, "row 'Bare'"),
        ({"rows": [{"label": "Bare", "method": "ingp", "settings": {"hull.k": 2}}]}, "row 'Bare'"),
        ({"rows": [{"label": "H", "method": "ingp"}], "kind": "hull"}, "row 'H'"),
        ({"metrics": ["pnsr"]}, "psnr"),
        ({"columns": [{"label": "c", "reading": {"mask_source": "folders"}}]}, "column 'c'"),
        ({"slurm": {"minutes": 3}}, "time_min"),
        ({"layout": {"bets": "none"}}, "best"),
        ({"rows": [{"label": "Bare", "method": "ingpp"}]}, "row 'Bare'"),
        ({"paper": "main_sota", "columns": [{"label": "c", "paper": {"dataset": "Mip"}}]}, "'c'"),
    ],
)
def test_a_tables_mistake_ends_with_2_before_anything_runs(small, tmp_path, capsys, changes, said, dry):
    _change(small, **changes)
    assert table.main([str(small), "--out", "t", *dry]) == 2
    assert said in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


def _resolve(name: str) -> Any:
    return make_workshop("cpu").resolve("train", name, "quick")


def test_a_misspelt_method_is_an_error_with_the_right_one():
    known = registry.installed()
    names = [*known.presets, *known.aliases]
    for name in names:
        wrong = {name.upper(), name.replace("-", "_"), f"{name}+", f"{name}+no-such-variant"}
        for i in range(len(name)):
            wrong |= {name[:i] + name[i + 1 :], name[: i + 1] + name[i:]}
            wrong.add(name[:i] + name[i : i + 2][::-1] + name[i + 2 :])
        for text in wrong - set(names):
            with pytest.raises(ConfigError, match="did you mean") as caught:
                _resolve(text)
            assert caught.value.what.split("'")[-2] in names, text
    with pytest.raises(ConfigError, match="did you mean 'zerorf'"):
        _resolve("zerorff")


def test_a_method_that_is_not_built_or_not_installed_is_not_available(caplog):
    named = {row.method for name in list_tables() for row in load_table(name).rows}
    assert named >= list_not_built()
    for name in (*list_not_built(), "nobodys-method", "nobodys-method+vd"):
        caplog.clear()
        assert _resolve(name) is None and repr(name) in caplog.text


def _places(node: Any, path: tuple = ()) -> list[tuple]:
    inside = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path, *(place for key, value in inside for place in _places(value, (*path, key)))]


def _put(node: Any, path: tuple, value: Any, as_key: bool) -> Any:
    """The node with something else at a place, or with another key for what is there."""
    if not path:
        return value
    changed = copy.copy(node)
    if len(path) > 1:
        changed[path[0]] = _put(node[path[0]], path[1:], value, as_key)
    elif as_key and isinstance(node, dict):
        changed[value] = changed.pop(path[0])
    else:
        changed[path[0]] = value
    return changed


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from(_places(EVERYTHING)), st.sampled_from(ODD), st.booleans())
def test_whatever_stands_in_a_table_it_is_a_table_or_a_clear_error(tmp_path, place, value, as_key):
    value = str(value) if as_key and isinstance(value, (list, dict)) else value
    file = tmp_path / "odd.yaml"
    file.write_text(yaml.safe_dump(_put(EVERYTHING, place, value, as_key), sort_keys=False))
    for edition in (None, "smoke"):
        try:
            spec = load_table(file, edition)
            run_table.run_spec(spec, run_table.TableOptions(dry_run=True, device="cpu", out=tmp_path / "t"))
        except ConfigError as error:
            assert error.what
        else:
            assert all(path.exists() for path in write_all(Results(spec), tmp_path / "written"))


def test_without_a_name_the_shipped_tables_are_listed(capsys):
    assert table.main([]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert names[: len(list_tables())] == list(list_tables())
