"""Paths and modules that the Markdown files name are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in (".", "docs", "docs/guide", "docs/guide/poses", "docs/findings", "examples", "benchmarks")
    for path in (ROOT / folder).glob("*.md")
)
PACKAGES = "visdom_plugin|method_configs|datamodules"
FOLDERS = f"{PACKAGES}|tests|benchmarks|examples|scripts|docs"
PATH = re.compile(rf"(?<![\w./-])(?:{FOLDERS})(?:/[\w.*-]+)*/(?:[\w.*-]*\w)?")
MODULE = re.compile(rf"(?<![\w./-])(?:{PACKAGES})(?:\.\w+)+")


def page(name: str) -> str:
    text = (ROOT / name).read_text(encoding="utf-8")
    # The changelog tells of names that are gone; the right side of its table of moved modules is as things are.
    return "\n".join(re.findall(r"(?m)^\| `[^`]*` \| (.*)", text)) if name == "CHANGELOG.md" else text


def is_there(path: str) -> bool:
    found = list(ROOT.glob(path))
    return any(p.is_file() or (any(p.rglob("*.*")) and not _only_cache(p)) for p in found)


def _only_cache(folder: Path) -> bool:
    return all("__pycache__" in p.parts for p in folder.rglob("*.*"))


def names_something(dotted: str) -> bool:
    """Whether it is a package, a module, or a name in one."""
    at, *rest = dotted.split(".")
    place = ROOT / at
    while rest and (place / rest[0]).is_dir():
        place /= rest.pop(0)
    if rest and (place / f"{rest[0]}.py").is_file():
        module, name = place / f"{rest.pop(0)}.py", r"\b{}\b"
    else:
        module, name = place / "__init__.py", r'"{}"'
    return module.is_file() and (not rest or re.search(name.format(rest[0]), module.read_text()) is not None)


@pytest.mark.parametrize("name", PAGES)
def test_named_paths_exist(name):
    assert [path for path in PATH.findall(page(name)) if not is_there(path)] == []


@pytest.mark.parametrize("name", PAGES)
def test_named_modules_exist(name):
    assert [dotted for dotted in MODULE.findall(page(name)) if not names_something(dotted)] == []


def test_the_search_finds_what_is_wrong():
    assert PATH.findall(
        "see `visdom_plugin/hull/hull.py`, (tests/hosts/) and benchmarks/hull/raycast.py."
    ) == [
        "visdom_plugin/hull/hull.py",
        "tests/hosts/",
        "benchmarks/hull/raycast.py",
    ]
    assert is_there("visdom_plugin/hull/hull.py") and not is_there("visdom_plugin/cameras.py")
    assert names_something("visdom_plugin.Hull") and names_something("visdom_plugin.hull.hull.Hull.save")
    assert not names_something("visdom_plugin.hull.hull.Nothing") and not names_something(
        "visdom_plugin.cameras"
    )
