"""docs/api.md says what the docstrings say."""

import ast
import importlib.util
import re
from pathlib import Path

import visdom_plugin

ROOT = Path(__file__).parents[2]


def make_api():
    spec = importlib.util.spec_from_file_location("make_api", ROOT / "scripts" / "make_api.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date():
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert page == make_api().make_page(), "run: python scripts/make_api.py"


def test_every_public_name_has_a_heading_and_a_description():
    sections = make_api().make_page().split("\n### ")
    described = {section.split("\n", 1)[0].strip("`"): section for section in sections}
    for name in set(visdom_plugin.__all__) - {"__version__"}:
        assert len(described[name].splitlines()) > 2, name
    assert "margin_voxels" in described["Hull"] and "_derived" not in described["Hull"]


def test_what_the_example_imports_is_described():
    page = make_api().make_page()
    for path in (ROOT / "examples/my_method/my_method").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in [
            n for n in tree.body if isinstance(n, ast.ImportFrom) and n.module.startswith("visdom_plugin")
        ]:
            for name in node.names:
                assert re.search(rf"^### `[\w.]*\b{name.name}\b", page, re.MULTILINE), (
                    f"{node.module}.{name.name}"
                )


def test_sections_of_a_docstring_become_lists():
    source = '''
def f(a, b):
    """One line.

    Args:
        a, b: two things
            on two lines.

    Returns:
        A sum, in two
        lines.

    Raises:
        ValueError: never.
    """
'''
    text = make_api().describe(ast.parse(source).body[0])
    assert text == (
        "One line.\n\n**Args**\n\n- `a`, `b`: two things on two lines.\n\n"
        "**Returns**\n\nA sum, in two lines.\n\n**Raises**\n\n- `ValueError`: never.\n"
    )
