"""The page of all error messages, read from the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGES = ("datamodules", "visdom_plugin", "method_configs")
CLASSES = ("SceneError", "EmptyHullError", "ConfigError", "CheckpointError", "PluginError", "unknown_name")
SUBJECTS = {
    "datamodules": "Reading scenes",
    "visdom_plugin/prepare": "Preparing photographs",
    "visdom_plugin/hull": "Hull, cameras and masks",
    "visdom_plugin/geometry": "Hull, cameras and masks",
    "visdom_plugin/scene.py": "Hull, cameras and masks",
    "visdom_plugin/hooks": "In your own trainer",
    "visdom_plugin/integrations": "In your own trainer",
    "visdom_plugin/training": "Training and runs",
    "visdom_plugin/methods": "Training and runs",
    "visdom_plugin/nerf": "Training and runs",
    "visdom_plugin/splat": "Training and runs",
    "visdom_plugin/validation.py": "Training and runs",
    "method_configs": "Training and runs",
    "visdom_plugin/registry.py": "Methods and plugins",
    "visdom_plugin/specs.py": "Methods and plugins",
    "visdom_plugin/export": "Exports and the viewer",
    "visdom_plugin/viewer": "Exports and the viewer",
    "visdom_plugin/tables": "Tables",
    "visdom_plugin/cli": "Options of commands",
    "visdom_plugin/workflow": "Functions from Python",
}
HEAD = """# All messages

For those who search the words of an error: every message of the commands and the library, read from the source,
and what to do. `...` stands for a value that is filled in. [Troubleshooting](guide/troubleshooting.md) says more
about the frequent ones.
"""


class Message(NamedTuple):
    """One place in the source that raises an error."""

    path: str
    what: str
    todo: str


def make_page() -> str:
    """The whole page: a table per subject."""
    subjects: dict[str, dict[str, str]] = {title: {} for title in SUBJECTS.values()}
    for message in find_messages():
        subjects[subject_of(message.path)].setdefault(message.what, message.todo)
    parts = [HEAD]
    for title, rows in subjects.items():
        parts.append(f"\n## {title}\n\n| message | what to do |\n| --- | --- |")
        parts += [f"| {_cell(what)} | {_cell(rows[what])} |" for what in sorted(rows, key=str.lower)]
    return "\n".join(parts) + "\n"


def find_messages() -> Iterator[Message]:
    """All messages of which some words stand in the source."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            where = path.relative_to(ROOT).as_posix()
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and _name(node.func) in CLASSES and node.args:
                    todo = next((k.value for k in node.keywords if k.arg == "todo"), None)
                    what = spell(node.args[0])
                    if len(re.findall(r"[a-z]{2,}", what)) > 2:
                        yield Message(where, what, spell(todo) if todo else "")


def subject_of(path: str) -> str:
    """The heading that a file's messages stand under."""
    return next(title for start, title in SUBJECTS.items() if path.startswith(start))


def spell(node: ast.AST) -> str:
    """The words of an expression that makes text, with `...` for what is computed."""
    if isinstance(node, ast.Constant):
        text = str(node.value)
    elif isinstance(node, ast.JoinedStr):
        text = "".join(spell(v) if isinstance(v, ast.Constant) else "..." for v in node.values)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        text = spell(node.left) + spell(node.right)
    elif isinstance(node, ast.IfExp):
        text = spell(node.body) or spell(node.orelse)
    else:
        text = "..."
    return re.sub(r"\.{4,}", "...", text)


def _name(node: ast.AST) -> str:
    return getattr(node, "id", None) or getattr(node, "attr", "")


def _cell(text: str) -> str:
    return re.sub(r"([|<*_\[\]])", r"\\\1", " ".join(text.split()))
