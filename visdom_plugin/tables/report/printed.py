"""A table as printed: its blocks in words, which the templates of Markdown, LaTeX and HTML lay out."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from visdom_plugin.tables.report.labels import (
    describe_numbers,
    describe_runs,
    heading,
    list_failures,
    spell_cell,
    spell_paper,
)
from visdom_plugin.tables.report.layout import Block, arrange
from visdom_plugin.tables.report.summary import Cell, Summary
from visdom_plugin.tables.spec import TableSpec

if TYPE_CHECKING:
    from jinja2 import Environment


@dataclass(frozen=True)
class PrintedCell:
    """One number in words."""

    number: str
    """Or why there is none."""
    spread: str
    """What stands behind ±; empty for most."""
    kind: str
    """"best", "second", "partial" (some jobs gave no number), "absent" (none did) or nothing."""
    paper: str
    """The paper's number; empty where there is none."""


@dataclass(frozen=True)
class PrintedRow:
    """One line of a block."""

    group: str
    """Heading of the group that begins here; empty elsewhere."""
    label: str
    cells: tuple[PrintedCell, ...]


@dataclass(frozen=True)
class PrintedBlock:
    """All rows, some numbers."""

    title: str
    heads: tuple[str, ...]
    papers: tuple[bool, ...]
    """Of each head: whether the paper prints anything for it."""
    rows: tuple[PrintedRow, ...]


def describe_table(spec: TableSpec, summary: Summary) -> dict[str, object]:
    """What every template is given."""
    return {
        "title": heading(spec),
        "label": re.sub(r"[^A-Za-z0-9]+", "-", spec.name).strip("-"),
        "blocks": [_print_block(spec, summary, block) for block in arrange(spec)],
        "numbers": describe_numbers(spec, summary),
        "runs": describe_runs(spec, summary),
        "notes": list(spec.notes),
        "failures": list_failures(spec, summary),
    }


def make_environment(escape: Callable[[str], str] | None = None, **options: Any) -> Environment:
    """Jinja for the templates in `pages`.

    Args:
        escape: applied to every value that is printed; by default HTML's rules are.
        options: of jinja, such as delimiters.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("visdom_plugin", "tables/report/pages"),
        autoescape=escape is None,
        finalize=escape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )


def _print_block(spec: TableSpec, summary: Summary, block: Block) -> PrintedBlock:
    rows, columns = [], []
    for head in block.heads:
        columns.append(
            [summary.cell(r, head.column, head.views, head.measure) for r in range(len(spec.rows))]
        )
    for r, row in enumerate(spec.rows):
        begins = r == 0 or spec.rows[r - 1].group != row.group
        cells = tuple(_print_cell(column[r], summary.layout.second) for column in columns)
        rows.append(PrintedRow(row.group if begins else "", row.label, cells))
    papers = tuple(any(cell.paper is not None for cell in column) for column in columns)
    return PrintedBlock(block.title, tuple(head.title for head in block.heads), papers, tuple(rows))


def _print_cell(cell: Cell, second: bool) -> PrintedCell:
    number, _, spread = spell_cell(cell).partition(" ± ")
    kind = "" if cell.whole else "partial" if cell.n else "absent"
    if cell.rank == 1 or (cell.rank == 2 and second):
        kind = "best" if cell.rank == 1 else "second"
    return PrintedCell(number, spread, kind, spell_paper(cell))
