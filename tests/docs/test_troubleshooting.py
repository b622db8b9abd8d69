"""Every topic of an error and every kind of a finding has its heading on the page that messages name."""

import ast
import re
from pathlib import Path

import pytest

from tests.docs.test_links import anchors
from visdom_plugin import errors
from visdom_plugin.cli.entry import run
from visdom_plugin.hull.checks.findings import KINDS

ROOT = Path(__file__).parents[2]
PAGE = ROOT / errors.PAGE
_TEXT = PAGE.read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### (\S+)\n(.*?)(?=^#|\Z)", _TEXT, re.M | re.S))
BESIDE = ("mask", "disk")
"""What commands say that is neither: a mask that cannot be read, in the check's table, and a full disk."""


SOURCES = {
    path: path.read_text(encoding="utf-8")
    for package in ("visdom_plugin", "datamodules", "method_configs")
    for path in sorted((ROOT / package).rglob("*.py"))
}


def values(node: ast.expr) -> set[str]:
    """What an expression may be, as far as it is spelled out: a string, or the two of a condition."""
    if isinstance(node, ast.IfExp):
        return values(node.body) | values(node.orelse)
    return {node.value} if isinstance(node, ast.Constant) and node.value is not None else set()


def used(sources=SOURCES) -> set[str]:
    """Topics of errors, and kinds of findings, in the source."""
    found = set()
    for text in sources.values():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.keyword) and node.arg == "topic":
                found |= values(node.value)
            if isinstance(node, ast.AnnAssign) and getattr(node.target, "id", "") == "usual" and node.value:
                found |= values(node.value)
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "usual":
                found |= values(node.value)
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("Finding", "Suspicion"):
                found |= values(node.args[0])
    return found


def named(sources=SOURCES) -> set[str]:
    """Headings of the page that the source names outright."""
    pattern = re.compile(r"""say_more\(["']([\w-]+)["']\)|PAGE\}#([\w-]+)""")
    return {a or b for text in sources.values() for a, b in pattern.findall(text)}


def test_every_name_has_a_section_and_every_section_a_name():
    names = {*errors.TOPICS, *KINDS, *BESIDE}
    assert set(SECTIONS) == names and names <= anchors(PAGE)
    assert all(len(text.split()) >= 8 for text in SECTIONS.values())


def test_names_in_the_source_are_registered_and_those_registered_are_used():
    assert used() <= {*errors.TOPICS, *KINDS}
    assert set(errors.TOPICS) <= used()


def test_every_place_that_a_message_ends_with_is_a_heading():
    assert {"findings", "disk"} <= named() <= anchors(PAGE)


def test_names_in_conditions_and_classes_are_seen():
    text = 'class E:\n    usual = "a"\n    usual: str = "b"\nE(topic="c" if x else "d" if y else None)\n'
    text += 'Finding("e" if x else "f")\nsay(f"{PAGE}#g" + say_more("h"))\n'
    assert used({0: text}) == set("abcdef") and named({0: text}) == {"g", "h"}


@pytest.mark.parametrize("kind", KINDS)
def test_every_finding_is_shown(kind):
    (picture,) = re.findall(r"!\[[^\]]+\]\((\S+)\)", SECTIONS[kind])
    assert picture == f"../pictures/findings/{kind}.webp"


def test_a_command_ends_its_message_with_the_place_that_tells_more(capsys):
    def fail(error: Exception):
        def command(argv):
            raise error

        assert run(command, []) == 2
        return capsys.readouterr().err.splitlines()

    assert fail(errors.SceneError("it is empty", todo="mend it", topic="empty")) == [
        "error: it is empty",
        "  what to do: mend it",
        f"  more: {errors.PAGE}#empty",
    ]
    assert fail(errors.EmptyHullError("nothing"))[-1] == f"  more: {errors.PAGE}#empty-hull"
    assert fail(errors.unknown_name("no", "a", ["b"]))[-1] == f"  more: {errors.PAGE}#unknown-name"
    assert fail(PermissionError(13, "Permission denied"))[-1] == f"  more: {errors.PAGE}#disk"
