"""The pages of the site that are made from the tree. `.ci/run` builds the site, which checks its links, too."""

import ast
import importlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

import visdom_plugin
from visdom_plugin.registry import installed

ROOT = Path(__file__).parents[2]
API = (ROOT / "docs/api.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^::: ([\w.]+)\n    options: \{.*members: \[([\w, ]+)\]\}$", API, re.M)


@pytest.fixture
def part(monkeypatch):
    """Imports one of the site's parts."""
    monkeypatch.syspath_prepend(ROOT / "scripts/site")
    yield importlib.import_module
    for path in (ROOT / "scripts/site").glob("*.py"):
        sys.modules.pop(path.stem, None)


def definitions(module: str) -> dict[str, ast.AST]:
    tree = ast.parse((ROOT / module.replace(".", "/")).with_suffix(".py").read_text(encoding="utf-8"))
    return {n.name: n for n in tree.body if isinstance(n, ast.ClassDef | ast.FunctionDef)}


def test_every_name_of_the_api_page_is_there_and_documented():
    assert len(SECTIONS) == API.count("\n::: ") > 20
    for module, members in SECTIONS:
        found = definitions(module)
        for name in members.split(", "):
            assert ast.get_docstring(found[name]), f"{module}.{name}"


def test_the_api_page_has_every_public_name_and_what_the_examples_import():
    described = {name for _, members in SECTIONS for name in members.split(", ")}
    assert set(visdom_plugin.__all__) - {"__version__"} <= described
    described |= {module.rpartition(".")[2] for module, _ in SECTIONS}
    for path in (ROOT / "examples/my_method").rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module.startswith("visdom_plugin"):
                assert {name.name for name in node.names} <= described, path


def test_every_page_of_docs_is_in_the_navigation(part):
    made = {*part("root_pages").PAGES.values(), "commands.md", "messages.md", "examples.md"}
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = re.findall(r"[\w/]+\.md", text)
    pages = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert sorted(named) == sorted(pages | made)


def test_the_page_of_commands_has_every_command_and_option(part):
    commands = part("commands")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    declared = re.findall(r'^(visdom-\w+) = "[\w.]+:main"$', project, re.M)
    assert set(commands.COMMANDS) == set(declared)
    said = commands.help_of("visdom-check", [])
    rows = dict(commands.options(said))
    assert {"--views INT", "--data {None}|PATH", "--json, --no-json"} <= set(rows)
    assert set(re.findall(r"^│ +(--[\w.-]+)", said, re.M)) == {
        o.split()[0].strip(",") for o in rows if o[:2] == "--"
    }
    assert rows["--seed INT"] == "Random seed. (default: 0)"
    page = commands.render(said, {"--seed INT"})
    assert "`--views INT`\n:   Number of training views" in page and "--seed" not in page
    whole = commands.make_page()
    assert "│" not in whole and "usage:" not in whole
    assert "```\nvisdom-eval runs/SCENE/VIEWS/METHOD/SEED\n" in whole
    settings = whole.partition("### visdom-train method:ingp+vd\n")[2].partition("\n## ")[0]
    assert re.search(r"^`--method.steps INT`\n:   \w.*\(default: 800\)$", settings, re.M)
    assert (
        "for `few_views_share`" in settings and "`--data" not in settings and "`The settings" not in settings
    )


@pytest.mark.parametrize("method", sorted(n for n in installed().presets if not n.endswith("+mask")))
def test_every_option_is_described(part, method):
    commands = part("commands")
    found = commands.options(commands.help_of("visdom-train", [f"method:{method}"]))
    assert len(found) > 30
    assert [option for option, text in found if not re.match(r"[\w`]", text)] == []


def test_the_page_of_messages_has_the_words_of_the_source(part):
    messages = part("messages")
    found = list(messages.find_messages())
    assert len(found) > 350
    assert "the mask is empty: no pixel of it is foreground" in {m.what for m in found}
    page = messages.make_page()
    assert page.count("\n| ") > 350 and "there is no COLMAP model in this folder" in page
    source = ast.parse('ConfigError(f"{a} is {b}; at least 1" + (f"; {c}" if d else ""))', mode="eval")
    assert messages.spell(source.body.args[0]) == "... is ...; at least 1; ..."


def test_links_out_of_docs_become_the_sites_own(part):
    pages = part("root_pages")
    text = "[a](docs/gpu.md#x) ![b](docs/pictures/b.png) [c](CHANGELOG.md) [d](examples/my_method) [e](https://e.org)"
    there = "[a](gpu.md#x) ![b](pictures/b.png) [c](changelog.md) d [e](https://e.org)"
    assert pages.relink(text, "README.md", "index.md") == there
    up = pages.relink("[f](../../FINDINGS.md)", "docs/guide/x.md", "guide/x.md")
    assert up == "[f](../findings/index.md)"
    code = "`a[b](c)`\n```\na[b](c)\n```\n"
    assert pages.relink(code, "README.md", "index.md") == code


def test_the_page_of_examples_has_every_script_and_notebook(part):
    pages = part("root_pages")
    shown = pages.show_examples()
    for path in (ROOT / "examples").iterdir():
        if path.suffix in (".py", ".ipynb"):
            assert f"`examples/{path.name}`" in shown
    script = pages.show_script("a.py", '"""One thing.\n\n    python a.py\n"""\n\nprint(1)\n')
    assert script == "## One thing\n\n`a.py`\n\npython a.py\n\n```py\nprint(1)\n```\n"
    cells = (
        '{"cells": [{"cell_type": "markdown", "source": ["# A"]}, {"cell_type": "code", "source": ["b"]}]}'
    )
    assert pages.show_notebook("n.ipynb", cells) == "## A\n\n`n.ipynb`\n\n```py\nb\n```\n"


def test_pages_of_wide_tables_have_their_contents_in_the_text_and_room_beside_it(part):
    pytest.importorskip("mkdocs")
    hook = part("hook")

    def page(place):
        return SimpleNamespace(file=SimpleNamespace(src_uri=place, generated_by=None), meta={})

    text = "# A\n\nOne.\n\n## B\n\n| 1 ± 2 | 3e-04 |\n"
    wide, narrow = page("findings/hull.md"), page("guide/choosing.md")
    made = hook.on_page_markdown(text, wide, None, None)
    row = "| 1\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}2 | 3e-\N{WORD JOINER}04 |"
    assert made == f"# A\n\nOne.\n\n[TOC]\n\n## B\n\n{row}\n"
    assert wide.meta == {"hide": ["toc"]}
    assert hook.on_page_content("x", wide, None, None) == '<div class="measured">x</div>'
    assert ".measured" in (ROOT / "docs/assets/site.css").read_text(encoding="utf-8")
    assert hook.on_page_markdown(text, narrow, None, None) == text and narrow.meta == {}
    assert hook.on_page_content("x", narrow, None, None) == "x"


def test_the_extra_is_bounded():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (needed,) = re.findall(r"^docs = \[(.*)\]$", project, re.M)
    assert all(re.search(r">=[\d.]+,<\d", one) for one in yaml.safe_load(f"[{needed}]"))
