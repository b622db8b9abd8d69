"""A table as Markdown, as CSV, and as LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from visdom_plugin.tables.report.labels import (
    describe_numbers,
    describe_runs,
    has_paper,
    heading,
    list_failures,
    mark_of,
    spell_cell,
    spell_paper,
    starts_group,
)
from visdom_plugin.tables.report.layout import Block, Head, Layout, arrange
from visdom_plugin.tables.report.summary import Cell, Summary
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


def to_markdown(spec: TableSpec, summary: Summary) -> str:
    """The whole table, block by block, with notes and failures below."""
    parts = [f"# {_md(heading(spec))}"]
    for block in arrange(spec):
        parts.append(f"## {_md(block.title)}\n\n{_md_block(spec, summary, block)}")
    parts.append(" ".join([*map(_md, describe_numbers(spec, summary)), _md(describe_runs(spec, summary))]))
    if spec.notes:
        parts.append("Notes:\n\n" + "\n".join(f"- {_md(note)}" for note in spec.notes))
    failures = list_failures(spec, summary)
    if failures:
        lines = [f"- {_md(place)}: {_md(' / '.join(error.split(chr(10))))}" for place, error in failures]
        parts.append("Failed:\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


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


def to_latex(spec: TableSpec, summary: Summary) -> str:
    """A `table*` for the package booktabs: best bold, second best underlined, the paper's numbers below ours."""
    lines = [r"% needs \usepackage{booktabs}", r"\begin{table*}", r"\centering"]
    for block in arrange(spec):
        lines += [*_tex_block(spec, summary, block), r"\par\medskip"]
    caption = [
        heading(spec) + ".",
        *describe_numbers(spec, summary),
        describe_runs(spec, summary),
        *spec.notes,
    ]
    lines += [
        rf"\caption{{{_tex(' '.join(caption))}}}",
        rf"\label{{tab:{re.sub(r'[^A-Za-z0-9]+', '-', spec.name)}}}",
    ]
    return "\n".join([*lines, r"\end{table*}"]) + "\n"


def _md_block(spec: TableSpec, summary: Summary, block: Block) -> str:
    paper = [has_paper(summary, h.column, h.views, h.measure) for h in block.heads]
    heads = ["method"]
    for head, there in zip(block.heads, paper, strict=True):
        heads += [_md(head.title), *(["paper"] if there else [])]
    lines = [_pipe(heads), _pipe(["---"] + ["---:"] * (len(heads) - 1))]
    for r, row in enumerate(spec.rows):
        if starts_group(spec, r):
            lines.append(_pipe([f"*{_md(row.group)}*"] + [""] * (len(heads) - 1)))
        words = [_md(row.label)]
        for head, there in zip(block.heads, paper, strict=True):
            cell = _cell(summary, r, head)
            words.append(_marked(cell, summary.layout, _md, ("**{}**", "_{}_")))
            words += [spell_paper(cell)] if there else []
        lines.append(_pipe(words))
    return "\n".join(lines)


def _tex_block(spec: TableSpec, summary: Summary, block: Block) -> list[str]:
    lines = [rf"\begin{{tabular}}{{l{'r' * len(block.heads)}}}", r"\toprule"]
    lines.append(rf" & \multicolumn{{{len(block.heads)}}}{{c}}{{{_tex(block.title)}}} \\")
    lines.append(rf"\cmidrule(lr){{2-{1 + len(block.heads)}}}")
    lines += [" & ".join(["", *(_tex(h.title) for h in block.heads)]) + r" \\", r"\midrule"]
    for r, row in enumerate(spec.rows):
        if starts_group(spec, r):
            lines += [
                *([r"\addlinespace"] if r else []),
                _tex_line([rf"\textit{{{_tex(row.group)}}}"], block),
            ]
        cells = [_cell(summary, r, h) for h in block.heads]
        ours = [_marked(c, summary.layout, _tex, (r"\textbf{{{}}}", r"\underline{{{}}}")) for c in cells]
        lines.append(_tex_line([_tex(row.label), *ours], block))
        theirs = [spell_paper(c) for c in cells]
        if any(theirs):
            small = [rf"\footnotesize {_tex(text)}" if text else "" for text in theirs]
            lines.append(_tex_line([r"\quad\footnotesize paper", *small], block))
    return [*lines, r"\bottomrule", r"\end{tabular}"]


def _tex_line(words: list[str], block: Block) -> str:
    return " & ".join(words + [""] * (1 + len(block.heads) - len(words))) + r" \\"


def _cell(summary: Summary, row: int, head: Head) -> Cell:
    return summary.cell(row, head.column, head.views, head.measure)


def _marked(cell: Cell, layout: Layout, escape: Callable[[str], str], marks: tuple[str, str]) -> str:
    """The cell's text with its number, not its spread, marked."""
    number, _, spread = spell_cell(cell).partition(" ± ")
    mark = mark_of(cell, layout)
    number = escape(number)
    if mark:
        number = marks[mark == "second"].format(number)
    return f"{number} {escape('± ' + spread)}" if spread else number


def _md(text: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", " ".join(text.split()))


def _tex(text: str) -> str:
    """Escaped, with a minus, not a hyphen, before numbers."""
    return "".join(_TEX.get(c, c) for c in re.sub(r"(?<!\w)-(?=\d)", MINUS, " ".join(text.split())))


def _pipe(words: Sequence[str]) -> str:
    return "| " + " | ".join(words) + " |"


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
