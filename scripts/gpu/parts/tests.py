"""The tests that need a CUDA device, by file, and the Triton kernels' own test."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from bench import Bench, Case, Disagrees

CHECKOUT = Path(__file__).resolve().parents[3]


def cases(bench: Bench) -> list[Case]:
    files = sorted(
        str(path.relative_to(CHECKOUT))
        for path in (CHECKOUT / "tests").rglob("test_*.py")
        if "mark.gpu" in path.read_text()
    )
    gpu = ["-m", "gpu"]
    found = [Case("all marked gpu", lambda b: run_pytest(b, "gpu", [*gpu, *files]), 100)]
    grid = [str(next((CHECKOUT / "tests").rglob("test_hash_grid.py"))), "-k", "triton"]
    found.append(Case("Triton against torch", lambda b: run_pytest(b, "triton", grid), 60))
    return bench.choose(found)


def run_pytest(bench: Bench, name: str, words: list[str]) -> dict:
    """Counts of one pytest call; `Disagrees` names what failed."""
    report = bench.work / f"pytest-{name}.xml"
    report.unlink(missing_ok=True)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x" if bench.tiny else "--tb=short",
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run(
        [*command, f"--junitxml={report}", *words], cwd=CHECKOUT, capture_output=True, text=True
    )
    print(done.stdout[-8000:], done.stderr[-2000:])
    if not report.exists():
        raise RuntimeError(f"pytest ended with {done.returncode}: {(done.stdout + done.stderr)[-400:]}")
    suite = ElementTree.parse(report).getroot().find("testsuite")
    counts = {k: int(suite.get(k)) for k in ("tests", "failures", "errors", "skipped")}
    values = {"passed": counts["tests"] - counts["failures"] - counts["errors"] - counts["skipped"], **counts}
    told = []
    for test in suite.iter("testcase"):
        for fault in (*test.findall("failure"), *test.findall("error")):
            told.append(f"{test.get('name')}: {(fault.get('message') or '')[:160]}")
    if told:
        raise Disagrees("; ".join(told[:8]), values)
    return values
