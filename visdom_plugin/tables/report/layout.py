"""Layout of a table: the `layout` entry of its file, and the blocks that every writer prints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.spec import TableSpec
from visdom_plugin.training.runs.config_io import from_plain

MEAN = "mean"
"""In place of a number of views: the mean over a column's numbers of views."""
WIDE = 6
"""More numbers side by side than this, and every column of the table file gets a block of its own."""


@dataclass(frozen=True)
class Layout:
    """The choices a table file has."""

    best: Literal["column", "group", "none"] = "column"
    """Among which rows the best is marked: all, those of one group, or not at all."""
    second: bool = True
    """Mark the second best, too."""
    mean: bool = False
    """Columns with several numbers of views get their mean."""
    pictures: bool = True
    """Pictures and curves on the HTML page."""


@dataclass(frozen=True)
class Head:
    """One number's place in the head of a block."""

    title: str
    column: int
    views: int | str
    measure: str


@dataclass(frozen=True)
class Block:
    """A part of the table that is printed as one: all rows, some numbers."""

    title: str
    heads: tuple[Head, ...]


def read_layout(spec: TableSpec) -> Layout:
    """The `layout` entry as a Layout.

    Raises:
        ConfigError: for unknown choices, with the valid ones.
    """
    return from_plain(Layout(), dict(spec.layout), spec.source or spec.name, "layout")


def list_views(spec: TableSpec, column: int) -> list[int | str]:
    """The numbers of views a column prints, with "mean" where the layout asks for it."""
    views: list[int | str] = list(spec.columns[column].views)
    return [*views, MEAN] if len(views) > 1 and read_layout(spec).mean else views


def arrange(spec: TableSpec) -> list[Block]:
    """The blocks of a table: one measure each; a table of one column has one block with all measures."""
    places = [(c, views) for c in range(len(spec.columns)) for views in list_views(spec, c)]
    if len(places) == 1:
        c, views = places[0]
        heads = [Head(_title(m), c, views, m) for m in spec.metrics]
        return [Block(f"{spec.columns[c].label}, {spell_views(views)}", tuple(heads))]
    blocks = []
    for m in spec.metrics:
        if len(places) <= WIDE:
            heads = [Head(_column_title(spec, c, views), c, views, m) for c, views in places]
            blocks.append(Block(_title(m), tuple(heads)))
            continue
        for c, column in enumerate(spec.columns):
            heads = [Head(spell_views(v), c, v, m) for v in list_views(spec, c)]
            blocks.append(Block(f"{_title(m)}, {column.label}", tuple(heads)))
    return blocks


def spell_views(views: int | str) -> str:
    """A number of views in print."""
    if views == MEAN:
        return "mean"
    return f"{views} view" + ("" if views == 1 else "s")


def _title(measure: str) -> str:
    return f"{MEASURES[measure].title} {MEASURES[measure].arrow}"


def _column_title(spec: TableSpec, c: int, views: int | str) -> str:
    same = len({v for column in spec.columns for v in column.views}) == 1
    label = spec.columns[c].label
    return label if same and len(spec.columns) > 1 else f"{label}, {spell_views(views)}"
