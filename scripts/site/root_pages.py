"""Pages of the site from README, FINDINGS, CHANGELOG, CONTRIBUTING, and from README and scripts of the examples.

Links between those files and docs/ work in the tree, and are turned into the site's here; of a link to any other
file of the tree the words stay.
"""

from __future__ import annotations

import ast
import inspect
import json
import posixpath
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "FINDINGS.md": "findings/index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "examples/README.md": "examples.md",
}
"""Files outside docs/ by their place on the site."""
_CODE = r"^```.*?^```$|`[^`\n]*`"
_LINK = re.compile(rf"{_CODE}|(!?)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)", re.M | re.S)


def read_page(source: str) -> str:
    """A file outside docs/, for its place on the site."""
    return relink((ROOT / source).read_text(encoding="utf-8"), source, PAGES[source])


def relink(text: str, source: str, place: str) -> str:
    """The text of the file `source` of the tree for the page `place` of the site."""

    def link(found: re.Match[str]) -> str:
        mark, words, path, anchor = found.groups()
        if path is None:
            return found[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        target = PAGES.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
        if target is None:
            return words
        return f"{mark}[{words}]({posixpath.relpath(target, posixpath.dirname(place) or '.')}{anchor or ''})"

    return _LINK.sub(link, text)


def show_examples() -> str:
    """The README of examples/, then its scripts and notebooks with what they say of themselves."""
    parts = [read_page("examples/README.md")]
    folder = ROOT / "examples"
    for path in sorted([*folder.rglob("*.py"), *folder.glob("*.ipynb")]):
        show = show_notebook if path.suffix == ".ipynb" else show_script
        parts.append(show(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")))
    return "\n".join(parts)


def show_script(name: str, source: str) -> str:
    """A section: the docstring's first line as the heading, the rest of it, the code."""
    said = ast.get_docstring(ast.parse(source))
    title, _, rest = (said or name).partition("\n")
    code = source.split('"""', 2)[2] if said else source
    return f"## {title.rstrip('.')}\n\n`{name}`\n\n{inspect.cleandoc(rest)}\n\n```py\n{code.strip()}\n```\n"


def show_notebook(name: str, source: str) -> str:
    """A section: the cells, one after the other, headings a level lower."""
    parts = []
    for cell in json.loads(source)["cells"]:
        text = "".join(cell["source"])
        code = cell["cell_type"] == "code"
        parts.append(f"```py\n{text}\n```" if code else re.sub("^#", "##", text, flags=re.M))
    return "\n\n".join([parts[0], f"`{name}`", *parts[1:]]) + "\n"
