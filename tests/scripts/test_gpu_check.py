"""The GPU check on a machine without a GPU: its dry run, and what becomes of cases that fail, die or hang."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CHECK = Path(__file__).resolve().parents[2] / "scripts" / "gpu" / "check.py"

TROUBLE = """
'''Cases that go wrong.'''
import os, time
from bench import Case, Disagrees

def fine(bench):
    return {"value": 1.5}

def fails(bench):
    raise ValueError("no such kernel")

def differs(bench):
    raise Disagrees("far off", {"value": 9})

def dies(bench):
    os._exit(7)

def hangs(bench):
    time.sleep(60)

def cases(bench):
    return bench.choose([Case("first", fine), Case("fails", fails), Case("differs", differs), Case("dies", dies),
            Case("hangs", hangs, 0.5), Case("last", fine)])
"""


def run(tmp_path, *words):
    command = [sys.executable, str(CHECK), str(tmp_path / "out"), "--device", "cpu", "--tiny"]
    done = subprocess.run(
        [*command, "--work", str(tmp_path / "work"), *words], capture_output=True, text=True, check=False
    )
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    return done, results, (tmp_path / "out" / "page.md").read_text()


@pytest.mark.slow
def test_the_dry_run_goes_through_kernels_hooks_and_steps(tmp_path):
    done, results, page = run(tmp_path, "parity", "hooks", "steps")
    assert done.returncode == 0, page
    assert {row["status"] for part in results["parts"].values() for row in part["cases"].values()} == {"ok"}
    for name in ("sampler bounds", "loss: ssim", "first step of corgs-lite+vd", "zipnerf-lite+vd"):
        assert f"| {name} |" in page


def test_what_goes_wrong_costs_only_itself(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "trouble.py").write_text(TROUBLE)
    # The folders `parts` of both places are one package.
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    done, results, page = run(tmp_path, "trouble")
    cases = results["parts"]["trouble"]["cases"]
    status = {name: row["status"] for name, row in cases.items()}
    assert done.returncode == 1
    assert status == {
        "first": "ok", "fails": "failed", "differs": "differs", "dies": "ended", "hangs": "ended", "last": "ok"
    }  # fmt: skip
    assert "no such kernel" in cases["fails"]["error"] and "exit status 7" in cases["dies"]["error"]
    assert cases["differs"]["values"] == {"value": 9} and "| last | 1.5 |" in page


def test_a_later_call_adds_to_the_results_of_an_earlier_one(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "trouble.py").write_text(TROUBLE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    run(tmp_path, "trouble", "--only", "first")
    (tmp_path / "out").rename(tmp_path / "before")
    _, results, _ = run(tmp_path, "trouble", "--only", "last", "--resume", str(tmp_path / "before"))
    assert set(results["parts"]["trouble"]["cases"]) == {"first", "last"}


def test_an_unknown_part_names_those_there_are(tmp_path):
    done = subprocess.run(
        [sys.executable, str(CHECK), str(tmp_path / "out"), "nosuch"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and "parity" in done.stderr
