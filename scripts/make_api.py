"""Writes docs/api.md from the docstrings: `python scripts/make_api.py`; `--check` says whether it is up to date.

Reads the source, imports nothing, and gives the same text in every version of Python.
"""

from __future__ import annotations

import ast
import inspect
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "api.md"
MODULES = {
    "datamodules/recognise.py": "Loading a scene",
    "visdom_plugin/geometry/cameras.py": "Cameras and rays",
    "visdom_plugin/geometry/camera_paths.py": "Camera paths",
    "visdom_plugin/hull/domain.py": "Carving",
    "visdom_plugin/hull/settings.py": "Settings of a hull",
    "visdom_plugin/hull/hull.py": "The hull",
    "visdom_plugin/hooks/sampler.py": "Radiance fields",
    "visdom_plugin/hooks/regularizer.py": "Gaussians",
    "visdom_plugin/hooks/protocols.py": "What hooks are",
    "visdom_plugin/hooks/settings.py": "Settings of hooks",
    "visdom_plugin/hooks/configs.py": "A method's part of the hooks",
    "visdom_plugin/integrations/gsplat.py": "gsplat",
    "visdom_plugin/integrations/nerfacc.py": "nerfacc",
    "visdom_plugin/render.py": "Renders",
    "visdom_plugin/scene.py": "Scenes",
    "visdom_plugin/losses.py": "Losses",
    "visdom_plugin/specs.py": "Offering a method",
    "visdom_plugin/registry.py": "Finding methods",
    "visdom_plugin/training/protocols.py": "What a method is",
    "visdom_plugin/training/batches.py": "Batches",
    "visdom_plugin/training/run.py": "Training and opening runs",
    "visdom_plugin/training/evaluate.py": "Rendering views",
    "visdom_plugin/methods/fields/common.py": "Helpers for radiance fields",
    "visdom_plugin/nerf/frame.py": "A radiance field's frame",
    "visdom_plugin/nerf/rendering/volume.py": "Volume rendering",
    "visdom_plugin/nerf/optimiser.py": "The optimiser of radiance fields",
    "visdom_plugin/errors.py": "Errors",
}
WITH_FUNCTIONS = {
    "gsplat": None,
    "nerfacc": None,
    "Losses": None,
    "Camera paths": None,
    "Loading a scene": {"load"},
    "Cameras and rays": {"project", "rays_of", "look_at_point"},
    "Finding methods": {"installed", "find"},
    "Training and opening runs": {"train", "restore", "evaluate_again", "export"},
    "Rendering views": {"render_on_white"},
    "Helpers for radiance fields": None,
    "A radiance field's frame": None,
    "Volume rendering": {"composite", "weights_from_density"},
}
"""Sections whose functions are listed, too, all or those named; elsewhere classes only."""
HEAD = """# Python API

Made from the docstrings by `python scripts/make_api.py`. Shapes stand in brackets; `...` is any leading shape.
Names without a module in their heading are imported from `visdom_plugin`, `load` from `datamodules`.
"""


def make_page() -> str:
    """The whole page."""
    public = public_names()
    parts = [HEAD]
    for path, title in MODULES.items():
        parts.append(f"## {title}\n")
        source = (ROOT / path).read_text(encoding="utf-8")
        lines, tree = source.splitlines(), ast.parse(source)
        module = path.removesuffix(".py").replace("/", ".")
        for node in tree.body:
            if not isinstance(node, ast.ClassDef | ast.FunctionDef) or node.name.startswith("_"):
                continue
            name = node.name if public.get(node.name) == module else f"{module}.{node.name}"
            if isinstance(node, ast.ClassDef):
                parts += describe_class(node, name, lines)
            elif title in WITH_FUNCTIONS and node.name in (WITH_FUNCTIONS[title] or {node.name}):
                parts += [f"### `{name}`\n", f"```\n{signature(node, lines)}\n```\n", describe(node)]
    return "\n".join(part for part in parts if part).rstrip() + "\n"


def public_names() -> dict[str, str]:
    """Names of `visdom_plugin` by the module they come from."""
    tree = ast.parse((ROOT / "visdom_plugin/__init__.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_HOME":
            return ast.literal_eval(node.value)
    raise LookupError("visdom_plugin/__init__.py has no _HOME")


def describe_class(node: ast.ClassDef, name: str, lines: list[str]) -> list[str]:
    """Heading, constructor, docstring, fields and public methods."""
    parts = [f"### `{name}`\n"]
    for method in node.body:
        if isinstance(method, ast.FunctionDef) and method.name == "__init__":
            parts.append(
                f"```\n{signature(method, lines).replace('__init__(self, ', node.name + '(')}\n```\n"
            )
    parts.append(describe(node))
    fields = []
    for field, comment in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and not field.target.id.startswith("_"):
            documented = isinstance(comment, ast.Expr) and isinstance(comment.value, ast.Constant)
            text = " ".join(inspect.cleandoc(comment.value.value).split()) if documented else ""
            written = " ".join(ast.get_source_segment("\n".join(lines), field).split())
            fields.append(f"- `{written}`" + (f": {text}" if text else ""))
    if fields:
        parts.append("\n".join(fields) + "\n")
    for method in node.body:
        if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
            marks = [ast.unparse(d) for d in method.decorator_list]
            shown = f"{method.name}" if "property" in marks else signature(method, lines)
            kind = " *(property)*" if "property" in marks else ""
            shown = shown.replace("(self, ", "(").replace("(self)", "()").replace("(cls, ", "(")
            parts += [f"**`{shown}`**{kind}\n", describe(method)]
    return parts


def signature(node: ast.FunctionDef, lines: list[str]) -> str:
    """The line(s) of `def` as one, without `def` and the colon."""
    text = " ".join(" ".join(lines[node.lineno - 1 : node.body[0].lineno - 1]).split("#")[0].split())
    return text.removeprefix("def ").rstrip(":").replace("( ", "(").replace(", )", ")").replace(" )", ")")


def describe(node: ast.AST) -> str:
    """A docstring as Markdown: sections become bold words, their entries a list."""
    out, section = [], None
    for line in (ast.get_docstring(node) or "").splitlines():
        if line in ("Args:", "Returns:", "Raises:"):
            section = line
            out += [f"**{line[:-1]}**", "", *([""] if section == "Returns:" else [])]
        elif section and line.startswith("    "):
            entry = line[4:]
            if entry.startswith(" "):
                out[-1] += " " + entry.strip()
            elif section != "Returns:" and ": " in entry:
                names, text = entry.split(": ", 1)
                out.append("- " + ", ".join(f"`{n}`" for n in names.split(", ")) + f": {text}")
            else:
                out[-1] = (out[-1] + " " + entry).strip()
        else:
            section = None if line else section
            out.append(line)
    return "\n".join(out) + "\n"


def main() -> int:
    page = make_page()
    if "--check" in sys.argv[1:]:
        current = PAGE.exists() and PAGE.read_text(encoding="utf-8") == page
        sys.stderr.write("" if current else "docs/api.md is out of date: run python scripts/make_api.py\n")
        return 0 if current else 1
    PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
