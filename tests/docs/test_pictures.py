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
def part(monkeypatch):
    """Imports one of the scripts."""
    monkeypatch.syspath_prepend(SCRIPTS)
    yield importlib.import_module
    for path in SCRIPTS.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.fixture
def made(part):
    """How many scripts make each picture."""
    scripts = [p.stem for p in SCRIPTS.glob("*.py") if "\nMAKES = " in p.read_text(encoding="utf-8")]
    return Counter(name for script in scripts for name in part(script).MAKES)


def test_every_picture_is_shown_and_has_one_maker(made):
    there = {p.relative_to(PICTURES).as_posix() for p in PICTURES.rglob("*.*")}
    assert named(PAGES) == there
    assert set(made) == there and set(made.values()) == {1}


def test_a_picture_without_a_maker_is_found(tmp_path, made):
    page = tmp_path / "a.md"
    page.write_text("![one](../pictures/report.webp) and ![two](pictures/findings/drawn_by_hand.webp)\n")
    assert named([page]) - set(made) == {"findings/drawn_by_hand.webp"}


def test_the_gallery_is_the_page_that_its_script_writes(part):
    gallery = part("gallery")
    page = (ROOT / "docs/gallery.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(.+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.M)
    metrics = ("psnr", "psnr_foreground", "ssim", "silhouette_iou")
    records = [
        {"method": method, "metrics": {"test": dict(zip(metrics, map(float, numbers), strict=True))}}
        for method, *numbers in rows
    ]
    methods = len(gallery.METHODS)
    assert [r["method"] for r in records] == list(gallery.METHODS) * len(gallery.SCENES)
    parts = [gallery.HEAD]
    for i, (scene, shown) in enumerate(gallery.SCENES.items()):
        found = records[i * methods : (i + 1) * methods]
        parts.append(gallery.section(scene, shown, gallery.MAKES[i], found))
    assert page == "\n".join(parts)
