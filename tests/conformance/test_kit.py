"""The kit passes what is whole and names the one fault of what is not. It runs once, for all of them."""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "my_method"
sys.path.insert(0, str(EXAMPLE))
try:
    from tests.conformance.broken import BROKEN
    from tests.conformance.whole import WHOLE
finally:
    sys.path.remove(str(EXAMPLE))


def kit(*words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, EXAMPLE))),
        "VISDOM_METHODS": "kit=tests.conformance.broken:METHODS",
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "--pyargs",
        "visdom_plugin.conformance",
    ]
    command += words
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1200)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """By method, its checks' names to what was said: "" where it was kept, None where it was skipped."""
    report = tmp_path_factory.mktemp("kit") / "report.xml"
    names = [word for name in (*WHOLE, *BROKEN) for word in ("--method", name)]
    done = kit(*names, f"--junitxml={report}")
    assert done.returncode == 1, done.stdout + done.stderr
    results: dict[str, dict[str, str | None]] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        check, _, subject = case.get("name").partition("[")
        wrong = [*case.iter("failure"), *case.iter("error")]
        said = wrong[0].get("message", "") + (wrong[0].text or "") if wrong else ""
        skipped = case.find("skipped") is not None
        mine = results.setdefault(subject.rstrip("]").partition("-")[0], {})
        # Of a check with several cases, what was wrong with any.
        mine[check] = said or mine.get(check) or (None if skipped else "")
    return results


@pytest.mark.parametrize("name", WHOLE)
def test_whole_methods_pass(found, name):
    wrong = {check: said for check, said in found[name].items() if said}
    assert not wrong
    assert sum(said is not None for said in found[name].values()) >= 16


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_promise_fails_its_check_and_no_other(found, name):
    wrong = {check: said for check, said in found[name].items() if said}
    assert list(wrong) == [BROKEN[name]], wrong
    assert "promised in: visdom_plugin." in wrong[BROKEN[name]] and "what to do: " in wrong[BROKEN[name]]


def test_every_check_has_a_method_that_fails_it(found):
    checks = {check for results in found.values() for check in results}
    assert checks == set(BROKEN.values())


def test_without_a_method_or_with_an_unknown_one_the_kit_says_which_there_are():
    for words, said in (((), "say which method"), (("--method", "SmallFeild"), "did you mean 'SmallField'?")):
        done = kit(*words)
        assert done.returncode == 4 and said in done.stderr, done.stderr
        assert "Traceback" not in done.stderr


def test_help_and_version_need_no_method():
    done = kit("--help")
    assert done.returncode == 0 and "--method=NAME" in done.stdout
    assert kit("--version").returncode == 0


def test_a_method_that_lacks_weights_is_skipped_with_the_reason(monkeypatch):
    monkeypatch.delenv("VISDOM_DIFFUSION_WEIGHTS", raising=False)
    done = kit("--method", "gaussianobject", "-rs")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "gaussianobject cannot be trained here" in done.stdout and "passed" not in done.stdout
