"""A table as Markdown, as CSV, and as LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

from visdom_plugin.tables.report.printed import describe_table, make_environment
from visdom_plugin.tables.report.summary import Summary
from visdom_plugin.tables.spec import TableSpec

CELL_FIELDS = (
    "row", "group", "method", "column", "views", "metric", "n", "of", "mean", "std", "rank",
    "paper", "difference", "status",
)  # fmt: skip
SCENE_FIELDS = (
    "row", "method", "column", "scene", "views", "seed", "metric", "value", "status", "error", "run",
)  # fmt: skip

MINUS = "\N{MINUS SIGN}"
_TEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    MINUS: "$-$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
} | {c: f"\\{c}" for c in "_&%#$"}
_TEX_DELIMITERS = {
    "block_start_string": "<%",
    "block_end_string": "%>",
    "variable_start_string": "<<",
    "variable_end_string": ">>",
    "comment_start_string": "<#",
    "comment_end_string": "#>",
}
"""LaTeX has braces of its own."""


def to_markdown(spec: TableSpec, summary: Summary) -> str:
    """The whole table, block by block, with notes and failures below."""
    return make_environment(_md).get_template("table.md").render(describe_table(spec, summary))


def to_latex(spec: TableSpec, summary: Summary) -> str:
    """A `table*` for the package booktabs: best bold, second best underlined, the paper's numbers below ours."""
    page = make_environment(_tex, **_TEX_DELIMITERS).get_template("table.tex")
    return page.render(describe_table(spec, summary)) + "\n"


def to_csv(spec: TableSpec, summary: Summary) -> str:
    """One line per cell, every digit of its numbers; empty where there is none."""
    lines = []
    for c in summary.cells:
        row, column = spec.rows[c.row], spec.columns[c.column]
        place = {"row": row.label, "group": row.group, "method": row.method, "column": column.label}
        numbers = {name: getattr(c, name) for name in CELL_FIELDS if name not in place and name != "metric"}
        lines.append(place | {"metric": c.measure} | numbers)
    return _write_csv(CELL_FIELDS, lines)


def to_scene_csv(spec: TableSpec, summary: Summary, folder: Path) -> str:
    """One line per job and metric; run directories as seen from `folder`, where the file will lie."""
    lines = []
    for v in summary.scenes:
        row, column = spec.rows[v.row], spec.columns[v.column]
        run = _seen_from(folder, v.job.run_dir if v.job else None)
        place = {
            "row": row.label,
            "method": row.method,
            "column": column.label,
            "metric": v.measure,
            "run": run,
        }
        lines.append(place | {name: getattr(v, name) for name in SCENE_FIELDS if name not in place})
    return _write_csv(SCENE_FIELDS, lines)


def _md(text: object) -> str:
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", " ".join(str(text).split()))


def _tex(text: object) -> str:
    """Escaped, with a minus, not a hyphen, before numbers."""
    return "".join(_TEX.get(c, c) for c in re.sub(r"(?<!\w)-(?=\d)", MINUS, " ".join(str(text).split())))


def _seen_from(folder: Path, run: Path | None) -> str | None:
    if run is None:
        return None
    run, folder = Path(run).absolute(), Path(folder).absolute()
    return run.relative_to(folder).as_posix() if run.is_relative_to(folder) else str(run)


def _write_csv(names: Sequence[str], lines: Sequence[dict[str, object]]) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({name: _csv_word(value) for name, value in line.items()})
    return file.getvalue()


def _csv_word(value: object) -> object:
    """Every digit of a float; text without control characters, of which csv quotes line feeds alone."""
    if isinstance(value, float):
        return repr(value)
    return re.sub(r"[\x00-\x08\x0b-\x1f]", " ", value) if isinstance(value, str) else value
