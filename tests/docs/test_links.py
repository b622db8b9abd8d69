"""Every relative link and picture in the Markdown files leads to a file that is there, and to a heading of it.

So does every page of docs/ that a source file names.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(
            p
            for folder in ("docs", "examples", "benchmarks", ".github")
            for p in (ROOT / folder).rglob("*.md")
        ),
    ]
)
SOURCES = sorted(
    path
    for folder in (
        "visdom_plugin",
        "datamodules",
        "method_configs",
        "examples",
        "benchmarks",
        "scripts",
        ".github",
    )
    for path in (ROOT / folder).rglob("*.*")
    if path.suffix in (".py", ".ipynb", ".sh", ".yml", ".yaml", ".html", ".js", ".toml")
)
NAMED = re.compile(r"(?<![\w/])(docs/[\w/]+\.md)(?:#([\w-]+))?")
LINK = re.compile(r"\]\((?!\w+:)([^)\s]+)\)")


def prose(page: Path) -> str:
    """The page without its blocks of code, in which `](` and `#` mean other things."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def anchors(page: Path) -> set[str]:
    """What the page's headings are called in links, as GitHub and the site call them."""
    headings = re.findall(r"^#+ +(.+)$", prose(page), re.M)
    named = re.findall(r"""<a id="([^"]+)">|\{ *#([\w-]+) *\}""", prose(page))
    return {slug(heading) for heading in headings} | {a or b for a, b in named}


def slug(heading: str) -> str:
    heading = re.sub(r"\{ *#[\w-]+ *\}", "", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", heading).replace(" ", "-")


def dead(page: Path) -> list[str]:
    found = []
    for link in LINK.findall(prose(page)):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_link_is_dead(page):
    assert dead(page) == []


def dead_mentions(text: str) -> list[str]:
    """Pages of docs/ that are named and not there, and headings that they do not have."""
    return [
        f"{name}#{anchor}".rstrip("#")
        for name, anchor in NAMED.findall(text)
        if not (ROOT / name).is_file() or (anchor and anchor not in anchors(ROOT / name))
    ]


def test_pages_that_source_files_name_are_there():
    named = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in SOURCES}
    assert len(named) > 300 and sum(len(NAMED.findall(text)) for text in named.values()) > 15
    assert {name: found for name, text in named.items() if (found := dead_mentions(text))} == {}


def test_a_dead_mention_is_found():
    text = "docs/gpu.md, docs/gone.md and (docs/guide/troubleshooting.md#mask-missing, docs/gpu.md#gone)"
    assert dead_mentions(text) == ["docs/gone.md", "docs/gpu.md#gone"]


def test_a_dead_link_is_found(tmp_path):
    page = tmp_path / "a.md"
    page.write_text("# One, two\n[a](a.md#one-two) [b](b.md) [c](#three) [d](https://e.org) ![e](e.png)\n")
    assert dead(page) == ["b.md", "#three", "e.png"]
