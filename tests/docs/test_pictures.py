"""Every picture of the documentation is made by a script of scripts/site/figures, which names it in MAKES."""

import importlib
import re
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
SCRIPTS = ROOT / "scripts/site/figures"
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def named(pages: list[Path]) -> set[str]:
    """Pictures that pages show, by their place below docs/pictures."""
    found = (
        re.findall(r"!\[[^\]]*\]\(\S*?pictures/([^)\s]+)\)", p.read_text(encoding="utf-8")) for p in pages
    )
    return {name for names in found for name in names}


@pytest.fixture
def made(monkeypatch):
    """How many scripts make each picture."""
    monkeypatch.syspath_prepend(SCRIPTS)
    scripts = [p.stem for p in SCRIPTS.glob("*.py") if "\nMAKES = " in p.read_text(encoding="utf-8")]
    yield Counter(name for script in scripts for name in importlib.import_module(script).MAKES)
    for path in SCRIPTS.glob("*.py"):
        sys.modules.pop(path.stem, None)


def test_every_picture_is_shown_and_has_one_maker(made):
    there = {p.relative_to(PICTURES).as_posix() for p in PICTURES.rglob("*.*")}
    assert named(PAGES) == there
    assert set(made) == there and set(made.values()) == {1}


def test_a_picture_without_a_maker_is_found(tmp_path, made):
    page = tmp_path / "a.md"
    page.write_text("![one](../pictures/report.webp) and ![two](pictures/findings/drawn_by_hand.webp)\n")
    assert named([page]) - set(made) == {"findings/drawn_by_hand.webp"}
