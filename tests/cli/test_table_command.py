from __future__ import annotations

import json

import pytest
import yaml

from visdom_plugin.cli import table
from visdom_plugin.tables.spec import list_tables

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
    assert table.main([str(small), "--out", "t", "--data", "empty", "--only", "Bare"]) == table.FAILURES
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
    ],
)
def test_a_users_mistake_ends_with_2_and_runs_nothing(small, tmp_path, capsys, words, said):
    assert table.main(words) == 2
    assert said in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["small.yaml"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rows": [{"label": "Bare", "method": "ingp", "settings": {"stps": 2}}]}, "row 'Bare'"),
        ({"rows": [{"label": "Bare", "method": "ingp", "settings": {"hull.k": 2}}]}, "row 'Bare'"),
        ({"rows": [{"label": "H", "method": "ingp"}], "kind": "hull"}, "row 'H'"),
        ({"metrics": ["pnsr"]}, "psnr"),
        ({"columns": [{"label": "c", "reading": {"mask_source": "folders"}}]}, "column 'c'"),
        ({"slurm": {"minutes": 3}}, "time_min"),
    ],
)
def test_a_tables_mistake_ends_with_2_before_anything_runs(small, tmp_path, capsys, changes, said):
    _change(small, **changes)
    assert table.main([str(small), "--out", "t"]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("t/runs/*"))


def test_without_a_name_the_shipped_tables_are_listed(capsys):
    assert table.main([]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert names[: len(list_tables())] == list(list_tables())
