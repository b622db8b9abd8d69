"""A table as a file: rows (methods), columns (scenes and views), seeds, metrics, and what may differ among them.

Plain data, read from YAML. Free of heavy imports.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from importlib.resources import files
from pathlib import Path, PurePath
from typing import Any

from visdom_plugin.errors import ConfigError
from visdom_plugin.training.runs.config_io import from_plain

BUILT_IN = "built-in"
"""Root and scene name of the scene that needs no folder."""
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


@dataclass(frozen=True)
class Row:
    """One line of the table: a method with settings."""

    label: str
    """As printed; unique within the table."""
    method: str
    """Name or alias of a preset; a hull table's rows say "hull"."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Dotted path inside the method's config to its value, e.g. {"hull.k": 2}."""
    paper: dict[str, Any] | None = None
    """Which of the paper's rows stands beside it, e.g. {"method": "ZipNeRF", "variant": "vd"}."""
    group: str = ""
    """Rows of one group stand together."""
    budget: str | None = None
    """In place of the table's budget."""


@dataclass(frozen=True)
class Column:
    """Scenes that are averaged, at one or several numbers of training views."""

    label: str
    root: str = BUILT_IN
    """"built-in", or the name of a data root, whose folder `--root NAME=DIR` or VISDOM_ROOT_<NAME> gives."""
    scenes: tuple[str, ...] = (BUILT_IN,)
    """Folders below the root; "." is the root itself."""
    views: tuple[int, ...] = (4,)
    """Numbers of training views; each makes jobs of its own."""
    downscale: float = 1.0
    data_format: str | None = None
    """How the scenes lie on disk; by default recognised."""
    paper: dict[str, Any] | None = None
    """Which of the paper's columns stands beside it, e.g. {"dataset": "MipNeRF360"}."""
    reading: dict[str, Any] = field(default_factory=dict)
    """Other options of visdom-train on how scenes are read, e.g. {"mask_source": "alpha", "frame": 10}."""


@dataclass(frozen=True)
class TableSpec:
    """A table: every row is run on every scene and number of views of every column, once per seed."""

    name: str
    title: str = ""
    kind: str = "train"
    """"train": a job is one visdom-train run. "hull": a job carves and measures one hull."""
    rows: tuple[Row, ...] = ()
    columns: tuple[Column, ...] = ()
    seeds: tuple[int, ...] = (0,)
    metrics: tuple[str, ...] = ("psnr",)
    """Names in run.json's metrics.test."""
    budget: str = "auto"
    """quick, full or auto, as for visdom-train."""
    varies: tuple[str, ...] = ()
    """Facts of the protocol that may differ inside this table; see FACTS."""
    paper: str | None = None
    """Name of the CSV of the paper's numbers."""
    layout: dict[str, Any] = field(default_factory=dict)
    """For the writers."""
    notes: tuple[str, ...] = ()
    """Printed below the table."""
    slurm: dict[str, Any] = field(default_factory=dict)
    """Resources on a cluster; see tables.slurm.SlurmConfig."""
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


def list_editions(path: Path) -> list[str]:
    """Names of a table file's editions."""
    return list(_mapping(_read(path).get("editions", {}), "editions", path))


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
    content = _read(path)
    editions = _mapping(content.pop("editions", {}), "editions", path)
    if edition:
        if edition not in editions:
            raise ConfigError(
                f"the table has no edition {edition!r}{_nearest(edition, editions)}",
                where=path,
                todo=f"editions there: {', '.join(editions) or 'none'}",
            )
        content = _merge(content, _mapping(editions[edition] or {}, f"editions.{edition}", path), path)
    return parse_table(content, path.stem, str(path), edition or "")


def parse_table(content: dict[str, Any], name: str, where: str, edition: str = "") -> TableSpec:
    """A table from plain data, as YAML holds it; see `load_table`.

    Beside the fields of TableSpec, `settings` may hold settings for all rows; a row's own win.
    """
    content = dict(content)
    shared = _mapping(content.pop("settings", {}), "settings", where)
    rows = [
        _parse(
            Row(label="", method=""),
            {
                **row,
                "settings": flatten(shared) | flatten(_mapping(row.get("settings", {}), "settings", where)),
            },
            f"rows[{i}]",
            where,
            required=("label", "method"),
        )
        for i, row in enumerate(_mappings(content.pop("rows", []), "rows", where))
    ]
    columns = [
        _parse(Column(label=""), _tidy_column(column), f"columns[{i}]", where, required=("label",))
        for i, column in enumerate(_mappings(content.pop("columns", []), "columns", where))
    ]
    for key in ("source", "edition"):
        if key in content:
            raise ConfigError(f"unknown setting {key!r}", where=where)
    for key in ("seeds", "metrics", "varies", "notes"):
        if key in content and not isinstance(content[key], (list, tuple)):
            content[key] = [content[key]]
    content.setdefault("name", name)
    spec = _parse(TableSpec(name=name), content, "", where, extra=("settings", "rows", "columns", "editions"))
    made = {f.name: getattr(spec, f.name) for f in fields(spec)}
    made |= {"rows": tuple(rows), "columns": tuple(columns), "source": where, "edition": edition}
    spec = TableSpec(**made)
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
    raise ConfigError(
        f"there is no table {text!r}{_nearest(text, shipped)}",
        todo=f"give a YAML file or one of: {', '.join(shipped) or '(none is shipped)'}",
    )


def _read(path: Path) -> dict[str, Any]:
    import yaml

    try:
        # libyaml's parser, where it is there, takes a tenth of the time.
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        content = yaml.load(Path(path).read_text(encoding="utf-8"), Loader=loader)
    except OSError as error:
        raise ConfigError(f"the table cannot be read: {error.strerror}", where=path) from error
    except (yaml.YAMLError, ValueError) as error:
        # ValueError: no text, or a date that no calendar has.
        raise ConfigError(f"the table is not YAML: {error}", where=path) from error
    return _mapping(content, "the file", path)


def _merge(base: Any, change: Any, where: object) -> Any:
    if not (isinstance(base, dict) and isinstance(change, dict)):
        return change
    merged = dict(base)
    for key, value in change.items():
        if key == "rows" and isinstance(value, dict) and isinstance(base.get("rows"), list):
            merged["rows"] = _merge_rows(base["rows"], value, where)
        else:
            merged[key] = _merge(base[key], value, where) if key in base else value
    return merged


def _merge_rows(rows: list[Any], changes: dict[str, Any], where: object) -> list[Any]:
    by_label = _mapping(changes, "rows", where)
    rows = _mappings(rows, "rows", where)
    labels = [str(row.get("label")) for row in rows]
    for label in by_label:
        if label not in labels:
            raise ConfigError(
                f"an edition changes a row {label!r} that is not there{_nearest(label, labels)}",
                where=where,
            )
    merged = [_merge(row, by_label.get(label, {}), where) for row, label in zip(rows, labels, strict=True)]
    return [row for row in merged if row is not None]


def _tidy_column(column: dict[str, Any]) -> dict[str, Any]:
    """One scene or number of views may stand without brackets."""
    tidy = dict(column)
    for key in ("scenes", "views"):
        if key in tidy and not isinstance(tidy[key], (list, tuple)):
            tidy[key] = [tidy[key]]
    if "scenes" in tidy:
        tidy["scenes"] = [
            str(scene) if isinstance(scene, (int, float)) else scene for scene in tidy["scenes"]
        ]
    return tidy


def flatten(settings: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Nested mappings to dotted paths: {"hull": {"k": 2}} and {"hull.k": 2} say the same."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{path}.{key}" if path else str(key)
        flat |= flatten(value, name) if isinstance(value, dict) else {name: value}
    return flat


def nest(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Dotted paths to nested mappings, as `settings.from_plain` takes them.

    Raises:
        ConfigError: when one path goes on behind another one's value.
    """
    nested: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, last = path.split(".")
        inner = nested
        for parent in parents:
            inner = inner.setdefault(parent, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"settings name both {parent!r} and {path!r}", where=where)
        if isinstance(inner.get(last), dict):
            raise ConfigError(f"settings name both {path!r} and what is inside it", where=where)
        inner[last] = value
    return nested


def _parse(
    template: Any,
    content: dict[str, Any],
    path: str,
    where: str,
    required: tuple[str, ...] = (),
    extra: tuple[str, ...] = (),
) -> Any:
    valid = [f.name for f in fields(template) if f.name not in ("source", "edition")]
    label = path or "the top level"
    for key in content:
        if key not in valid:
            every = list(dict.fromkeys([*valid, *extra]))
            raise ConfigError(
                f"unknown setting {key!r} at {label}{_nearest(str(key), every)}",
                where=where,
                todo=f"valid names at {label}: {', '.join(every)}",
            )
    for key in required:
        if not content.get(key):
            raise ConfigError(f"{path} has no {key}", where=where)
    return from_plain(template, content, where, path)


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
    _choose("kind", spec.kind, ("train", "hull"), where)
    for row in spec.rows:
        _choose(f"budget of row {row.label!r}", row.budget or spec.budget, ("quick", "full", "auto"), where)
    for name in spec.varies:
        if not name.startswith("hull."):
            _choose("a fact in varies", name, FACTS, where)
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
        if column.root == BUILT_IN and column.scenes != (BUILT_IN,):
            raise ConfigError(
                f"column {column.label!r} names scenes of the built-in root: {', '.join(column.scenes)}",
                where=where,
                todo="give `root:` a name and pass its folder with --root NAME=DIR, or leave `scenes:` out",
            )


def _choose(what: str, value: str, valid: tuple[str, ...], where: str) -> None:
    if value not in valid:
        raise ConfigError(
            f"{what} is {value!r}{_nearest(value, valid)}",
            where=where,
            todo=f"use one of: {', '.join(valid)}",
        )


def _demand_different(what: str, values: Iterable[Any], where: str) -> None:
    values = list(values)
    if not values or len(set(values)) < len(values):
        shown = ", ".join(map(str, values)) or "none"
        raise ConfigError(f"{what} must be one or more different values, not {shown}", where=where)


def _mapping(value: Any, what: str, where: object) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{what} must be a mapping, not {type(value).__name__}", where=where)
    return {str(key): entry for key, entry in value.items()}


def _mappings(value: Any, what: str, where: object) -> list[dict[str, Any]]:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"{what} must be a list, not {type(value).__name__}", where=where)
    return [_mapping(entry, f"{what}[{i}]", where) for i, entry in enumerate(value)]


def _nearest(name: str, valid: Any) -> str:
    near = difflib.get_close_matches(name, [str(v) for v in valid], 1, 0.5)
    return f"; did you mean {near[0]!r}?" if near else ""
