"""A table as a file: rows (methods), columns (scenes and views), seeds, metrics, and what may differ among them.

Plain data, read from YAML. Free of heavy imports.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path, PurePath
from typing import Literal, TypeVar

from visdom_plugin.errors import ConfigError, unknown_name
from visdom_plugin.training.runs.config_io import from_plain, read_mapping

BUILT_IN = "built-in"
"""Root of the scenes that need no folder, and the name of the first of them."""
FACTS = (
    "budget",
    "downscale",
    "hull.k",
    "hull.kind",
    "evaluation.background",
    "metrics.definition",
    "schema",
    "views",
)
"""Facts of the protocol that `varies` may name; see tables.protocol."""
Budget = Literal["auto", "quick", "standard", "full"]
Settings = dict[str, object]
"""What a table file says by names, checked by whoever the names belong to."""
T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """One line of the table: a method with settings."""

    label: str
    """As printed; unique within the table."""
    method: str
    """Name or alias of a preset; a hull table's rows say "hull"."""
    settings: Settings = field(default_factory=dict)
    """Dotted path inside the method's config to its value, e.g. {"hull.k": 2}."""
    paper: Settings | None = None
    """Which of the paper's rows stands beside it, e.g. {"method": "ZipNeRF", "variant": "vd"}."""
    group: str = ""
    """Rows of one group stand together."""
    budget: Budget | None = None
    """In place of the table's budget."""


@dataclass(frozen=True)
class Column:
    """Scenes that are averaged, at one or several numbers of training views."""

    label: str
    root: str = BUILT_IN
    """"built-in", or the name of a data root, whose folder `--root NAME=DIR` or VISDOM_ROOT_<NAME> gives."""
    scenes: tuple[str, ...] = (BUILT_IN,)
    """Folders below the root; "." is the root itself. Of the built-in root, names as after `builtin:`."""
    views: tuple[int, ...] = (4,)
    """Numbers of training views; each makes jobs of its own."""
    downscale: float = 1.0
    data_format: str | None = None
    """How the scenes lie on disk; by default recognised."""
    paper: Settings | None = None
    """Which of the paper's columns stands beside it, e.g. {"dataset": "MipNeRF360"}."""
    reading: Settings = field(default_factory=dict)
    """Other options of visdom-train on how scenes are read, e.g. {"mask_source": "alpha", "frame": 10}."""


@dataclass(frozen=True)
class TableFile:
    """What a table file may hold."""

    name: str
    title: str = ""
    kind: Literal["train", "hull"] = "train"
    """"train": a job is one visdom-train run. "hull": a job carves and measures one hull."""
    settings: Settings = field(default_factory=dict)
    """Settings of all rows; a row's own win."""
    rows: tuple[Row, ...] = ()
    columns: tuple[Column, ...] = ()
    seeds: tuple[int, ...] = (0,)
    metrics: tuple[str, ...] = ("psnr",)
    """Names in run.json's metrics.test."""
    budget: Budget = "auto"
    """quick, standard, full or auto, as for visdom-train."""
    varies: tuple[str, ...] = ()
    """Facts of the protocol that may differ inside this table; see FACTS."""
    not_built: tuple[str, ...] = ()
    """Methods that no package here offers: their rows stay empty until one does."""
    paper: str | None = None
    """Name of the CSV of the paper's numbers."""
    layout: Settings = field(default_factory=dict)
    """For the writers."""
    notes: tuple[str, ...] = ()
    """Printed below the table."""
    slurm: Settings = field(default_factory=dict)
    """Resources on a cluster; see tables.run.slurm.SlurmConfig."""
    editions: Settings = field(default_factory=dict)
    """Name to what is different in this edition; see `load_table`."""


@dataclass(frozen=True)
class TableSpec(TableFile):
    """A table: every row is run on every scene and number of views of every column, once per seed."""

    source: str = ""
    """The file it was read from, for messages."""
    edition: str = ""
    """The edition chosen; empty for the table as it stands."""

    @property
    def folder_name(self) -> str:
        """What its folder is called by default: name and edition."""
        return "-".join(filter(None, (self.name, self.edition)))


def list_tables() -> dict[str, Path]:
    """Names of the shipped tables, with their files."""
    folder = Path(str(files("method_configs"))) / "tables"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_table(name_or_path: str | Path, edition: str | None = None) -> TableSpec:
    """Reads a table.

    Args:
        name_or_path: a shipped table's name or a YAML file; either may end in `:EDITION`.
        edition: the edition to take. Its mappings are merged into the table's, its other values replace them;
            `rows` as a mapping {label: changes} changes single rows (null removes one).

    Raises:
        ConfigError: for a file that cannot be read, unknown names (the nearest and all valid ones are listed),
            values of the wrong type, double labels, and an unknown edition.
    """
    path, edition = _find(str(name_or_path), edition)
    content: Settings = read_mapping(path, "the table")
    editions = content["editions"] = _mapping(content.get("editions", {}), "editions", path)
    if edition:
        if edition not in editions:
            what = f"the table has no edition {edition!r}"
            raise unknown_name(what, edition, editions, where=path, todo="editions there")
        content |= _merge(content, _mapping(editions[edition] or {}, f"editions.{edition}", path), path)
    return parse_table(content, path.stem, str(path), edition or "")


def parse_table(content: Settings, name: str, where: str, edition: str = "") -> TableSpec:
    """A table from plain data, as YAML holds it; see `load_table`."""
    content = {"name": name, **_in_brackets(content, "seeds", "metrics", "varies", "notes")}
    rows, columns = (_mappings(content.pop(key, []), key, where) for key in ("rows", "columns"))
    shared = flatten(_mapping(content.get("settings", {}), "settings", where))
    for row in rows:
        row["settings"] = shared | flatten(_mapping(row.get("settings", {}), "settings", where))
    made = from_plain(TableFile(name), content, where)
    spec = TableSpec(**vars(made), source=where, edition=edition)
    spec = replace(
        spec,
        rows=tuple(_parse(Row("", ""), row, f"rows[{i}]", where, "method") for i, row in enumerate(rows)),
        columns=tuple(_parse(Column(""), _tidy(c), f"columns[{i}]", where) for i, c in enumerate(columns)),
    )
    check_spec(spec, where)
    return spec


def _find(text: str, edition: str | None) -> tuple[Path, str | None]:
    shipped = list_tables()
    base, colon, named = text.rpartition(":")
    if colon and named and text not in shipped and not Path(text).is_file():
        if edition and edition != named:
            raise ConfigError(f"two editions: {named} and {edition}", todo="name one")
        text, edition = base, named
    if text in shipped:
        return shipped[text], edition
    path = Path(text).expanduser()
    if path.is_file():
        return path, edition
    raise unknown_name(f"there is no table {text!r}", text, shipped, todo="give a YAML file or one of")


def _merge(base: Settings, change: Settings, where: object) -> Settings:
    merged = dict(base)
    for key, value in change.items():
        old = base.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            merged[key] = _merge(old, value, where)
        elif isinstance(value, dict) and isinstance(old, list) and key == "rows":
            merged[key] = _merge_rows(_mappings(old, "rows", where), _mapping(value, "rows", where), where)
        else:
            merged[key] = value
    return merged


def _merge_rows(rows: list[Settings], by_label: Settings, where: object) -> list[Settings]:
    labels = [str(row.get("label")) for row in rows]
    for label in by_label:
        if label not in labels:
            what = f"an edition changes a row {label!r} that is not there"
            raise unknown_name(what, label, labels, where=where, todo="rows there")
    merged = []
    for row, label in zip(rows, labels, strict=True):
        change = by_label.get(label, {})
        if change is not None:
            merged.append(_merge(row, _mapping(change, f"rows.{label}", where), where))
    return merged


def _in_brackets(content: Settings, *keys: str) -> Settings:
    """One value may stand without brackets where a list is meant."""
    alone = {k: v for k, v in content.items() if k in keys and not isinstance(v, (list, tuple))}
    return content | {key: [value] for key, value in alone.items()}


def _tidy(column: Settings) -> Settings:
    """Scenes and views as lists; scenes that YAML takes for numbers as the text they are."""
    tidy = _in_brackets(column, "scenes", "views")
    if isinstance(scenes := tidy.get("scenes"), (list, tuple)):
        tidy["scenes"] = [str(scene) if isinstance(scene, (int, float)) else scene for scene in scenes]
    return tidy


def flatten(settings: Mapping[str, object], path: str = "") -> Settings:
    """Nested mappings to dotted paths: {"hull": {"k": 2}} and {"hull.k": 2} say the same."""
    flat: Settings = {}
    for key, value in settings.items():
        name = f"{path}.{key}" if path else str(key)
        flat |= flatten(value, name) if isinstance(value, dict) else {name: value}
    return flat


def nest(settings: Mapping[str, object], where: str) -> Settings:
    """Dotted paths to nested mappings, as `settings.from_plain` takes them.

    Raises:
        ConfigError: when one path goes on behind another one's value.
    """
    nested: Settings = {}
    for path, value in settings.items():
        *parents, last = path.split(".")
        inner = nested
        for parent in parents:
            deeper = inner.setdefault(parent, {})
            if not isinstance(deeper, dict):
                raise ConfigError(f"settings name both {parent!r} and {path!r}", where=where)
            inner = deeper
        if isinstance(inner.get(last), dict):
            raise ConfigError(f"settings name both {path!r} and what is inside it", where=where)
        inner[last] = value
    return nested


def _parse(template: T, content: Settings, path: str, where: str, *required: str) -> T:
    made = from_plain(template, content, where, path)
    for key in ("label", *required):
        if not getattr(made, key):
            raise ConfigError(f"{path} has no {key}", where=where)
    return made


def check_spec(spec: TableSpec, where: str) -> None:
    """Refuses values that no table can have.

    Args:
        where: where they were given.

    Raises:
        ConfigError: naming the row or column.
    """
    name = spec.folder_name
    if not re.fullmatch(r"[^/\\\0-\x1f]+", name) or name in (".", ".."):
        raise ConfigError(
            f"a table cannot be called {name!r}",
            where=where,
            cause="its folder is named after its `name:` and edition",
            todo="use a name without slashes",
        )
    for kind, entries in (("rows", spec.rows), ("columns", spec.columns)):
        if not entries:
            raise ConfigError(f"the table has no {kind}", where=where)
        labels = [entry.label for entry in entries]
        double = sorted({label for label in labels if labels.count(label) > 1})
        if double:
            raise ConfigError(
                f"two {kind} have the label {double[0]!r}", where=where, todo="make labels unique"
            )
    _demand_different("seeds", spec.seeds, where)
    _demand_different("metrics", spec.metrics, where)
    for name in spec.varies:
        if not name.startswith("hull.") and name not in FACTS:
            raise unknown_name(f"varies has no fact {name!r}", name, FACTS, where=where)
    for column in spec.columns:
        # A scene or a number of views that counts twice would weigh twice in means.
        _demand_different(f"views of column {column.label!r}", column.views, where)
        _demand_different(f"scenes of column {column.label!r}", map(PurePath, column.scenes), where)
        if min(column.views) < 1 or not 1 <= column.downscale < math.inf:
            raise ConfigError(
                f"column {column.label!r} has views {list(column.views)} and downscale {column.downscale:g}; "
                "both must be 1 or more",
                where=where,
            )


def _demand_different(what: str, values: Iterable[object], where: str) -> None:
    values = list(values)
    if not values or len(set(values)) < len(values):
        shown = ", ".join(map(str, values)) or "none"
        raise ConfigError(f"{what} must be one or more different values, not {shown}", where=where)


def _mapping(value: object, what: str, where: object) -> Settings:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{what} must be a mapping, not {type(value).__name__}", where=where)
    return {str(key): entry for key, entry in value.items()}


def _mappings(value: object, what: str, where: object) -> list[Settings]:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"{what} must be a list, not {type(value).__name__}", where=where)
    return [_mapping(entry, f"{what}[{i}]", where) for i, entry in enumerate(value)]
