"""Jobs of a table: every setting is resolved and every scene found before anything runs.

A job's run directory is named after a hash of its resolved settings, seed and the files it reads, so that the same
run is found again by any table, and a changed setting or photograph makes another run.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.errors import ConfigError, SceneError, list_some
from visdom_plugin.tables.protocol import Fact, facts_of_settings, refuse_mixture
from visdom_plugin.tables.results import Job, Outcome
from visdom_plugin.tables.run.job_files import beside
from visdom_plugin.tables.spec import BUILT_IN, Column, Row, Settings, TableSpec, nest
from visdom_plugin.training.runs.config_io import as_plain, from_plain

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Resolved:
    """A row's method, found."""

    name: str
    """The method's own name, aliases resolved."""
    budget: str
    """quick, standard or full."""
    config: object
    """Settings dataclass of that budget."""


@dataclass(frozen=True)
class Workshop:
    """What commands hand to the tables room."""

    resolve: Callable[[str, str, str], Resolved | None]
    """(kind, method, budget) to the method's settings; None where no such method is installed."""
    modules: Mapping[str, str]
    """Kind to the module whose `main(argv) -> exit status` does such a job."""
    hash_data: Callable[[str, Path | None, Settings, object], str]
    """(kind, scene's folder or None for the built-in scene, how it is read, the row's settings) to a hash of all
    data that such a job reads."""
    tidy_reading: Callable[[Settings, str], Settings] = lambda reading, where: dict(reading)
    """(a column's `reading`, where it stands) to the same, checked, with full paths."""
    require_views: Callable[[object, int], None] = lambda settings, views: None
    """(a row's settings, a column's number of views) raises ConfigError where there are too few views."""
    device: str = "auto"


@dataclass(frozen=True)
class Task:
    """One run directory to make. Several jobs may share it."""

    run_dir: Path
    module: str
    argv: tuple[str, ...]
    content: Settings = field(repr=False, default_factory=dict)
    """What its settings file holds."""
    steps: int = 0
    """Length of its schedule, where known."""
    label: str = ""
    """For the user."""
    method: str = ""
    """What tasks of about the same duration have in common."""
    trouble: str = ""
    """Why its scene cannot be read; its run will fail with these words."""

    def write_settings(self) -> None:
        """Writes the file that `--config` of the argv names."""
        import yaml

        text = yaml.safe_dump(self.content, sort_keys=False, allow_unicode=True)
        path = beside(self.run_dir, ".yaml")
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_bytes(path, text.encode())


@dataclass(frozen=True)
class Plan:
    """A table's jobs in order, and the tasks to run for them."""

    spec: TableSpec
    jobs: dict[Job, Outcome]
    """Outcome of jobs that cannot be run; "waiting" for all others."""
    tasks: dict[Path, Task]
    """By run directory."""


def find_root(name: str, roots: Mapping[str, Path]) -> Path | None:
    """The folder of a data root: from --root, or from VISDOM_ROOT_<NAME>."""
    if name in roots:
        return Path(roots[name]).expanduser()
    given = os.environ.get(variable_of(name))
    return Path(given).expanduser() if given else None


def variable_of(root: str) -> str:
    """The environment variable of a data root: "mip-nerf" has VISDOM_ROOT_MIP_NERF."""
    return "VISDOM_ROOT_" + re.sub(r"\W", "_", root).upper()


def plan(
    spec: TableSpec,
    runs: Path,
    workshop: Workshop,
    roots: Mapping[str, Path] | None = None,
    only: Sequence[int] | None = None,
) -> Plan:
    """All jobs of a table.

    Args:
        runs: folder of run directories.
        roots: name to folder of data roots.
        only: positions of the rows that will be run, where not all are.

    Raises:
        ConfigError: for a setting that a row's method does not have or that is out of range (naming the row), a
            row to be run that needs more views than a column has, a root that is no folder, a scene that is not
            in it, and a mixture of protocols.
    """
    resolved = [_resolve(spec, row, workshop) for row in spec.rows]
    _refuse_few_views(spec, resolved, workshop, only)
    readings = [workshop.tidy_reading(column.reading, _place(spec, column)) for column in spec.columns]
    refuse_mixture(_facts(spec, resolved), spec.varies, spec.source)
    folders = [_find_scenes(spec, column, dict(roots or {})) for column in spec.columns]
    looked_at = {path for scenes in folders if scenes for path in scenes.values() if path and path.is_dir()}
    if looked_at:
        log.info("reading the files of %d scene%s", len(looked_at), "s" * (len(looked_at) != 1))
    jobs: dict[Job, Outcome] = {}
    tasks: dict[Path, Task] = {}
    for (i, found), (j, column) in product(enumerate(resolved), enumerate(spec.columns)):
        paths = folders[j]
        for scene, views, seed in product(column.scenes, column.views, spec.seeds):
            job = Job(i, j, scene, views, seed)
            if found is None or paths is None:
                jobs[job] = Outcome("not available" if found is None else "no data")
                continue
            reading = {"views": views, "downscale": column.downscale, "data_format": column.data_format}
            task = _make_task(spec, job, found, paths[scene], reading | readings[j], runs, workshop)
            task = tasks.setdefault(task.run_dir, task)
            jobs[replace(job, run_dir=task.run_dir, argv=task.argv)] = Outcome("waiting")
    return Plan(spec, jobs, tasks)


def _resolve(spec: TableSpec, row: Row, workshop: Workshop) -> Resolved | None:
    where = f"row {row.label!r} of {spec.source}"
    nested = nest(row.settings, where)
    try:
        found = workshop.resolve(spec.kind, row.method, row.budget or spec.budget)
        if found is None:
            return None
        return replace(found, config=from_plain(found.config, nested, where))
    except ConfigError as error:
        if error.where == where:
            raise
        # Raised by a config class, which knows its own name only.
        raise _within(where, error) from error


def _refuse_few_views(
    spec: TableSpec, resolved: list[Resolved | None], workshop: Workshop, only: Sequence[int] | None
) -> None:
    rows = range(len(resolved)) if only is None else only
    for i, column in product(rows, spec.columns):
        found = resolved[i]
        if found is not None:
            try:
                workshop.require_views(found.config, min(column.views))
            except ConfigError as error:
                label = spec.rows[i].label
                raise ConfigError(
                    error.what,
                    where=f"row {label!r} and column {column.label!r} of {spec.source}",
                    todo="more views (`views` there, or --views), a smaller hull.k, or --only with other rows",
                    topic=error.topic,
                ) from error


def _within(where: str, error: ConfigError) -> ConfigError:
    inner = "" if error.where is None else f" ({error.where})"
    return ConfigError(error.what, where=where + inner, cause=error.cause, todo=error.todo, topic=error.topic)


def _place(spec: TableSpec, column: Column) -> str:
    return f"column {column.label!r} of {spec.source}"


def _facts(spec: TableSpec, resolved: list[Resolved | None]) -> list[Fact]:
    facts: list[Fact] = [("downscale", c.downscale, f"column {c.label!r}") for c in spec.columns]
    for row, found in zip(spec.rows, resolved, strict=True):
        if found is not None:
            owner = f"row {row.label!r}"
            facts.append(("budget", found.budget, owner))
            facts += [(k, v, owner) for k, v in facts_of_settings(as_plain(found.config), spec.kind).items()]
    return facts


def _find_scenes(spec: TableSpec, column: Column, roots: dict[str, Path]) -> dict[str, Path | None] | None:
    """Scene name to folder (None, or builtin:NAME, for a built-in scene); None, with a warning, where the root is
    not here."""
    if column.root == BUILT_IN:
        return {name: None if name == BUILT_IN else Path(f"builtin:{name}") for name in column.scenes}
    root = find_root(column.root, roots)
    if root is None:
        log.warning(
            "column %r is left empty: the data root %r is not here; pass --root %s=DIR or set %s",
            column.label,
            column.root,
            column.root,
            variable_of(column.root),
        )
        return None
    where = _place(spec, column)
    if not root.is_dir():
        raise ConfigError(
            f"the data root {column.root!r} is no folder: {root}",
            where=where,
            todo=f"--root {column.root}=DIR",
        )
    found: dict[str, Path | None] = {}
    for scene in column.scenes:
        path = root / scene
        if not path.is_dir():
            there = sorted(p.name for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))
            raise ConfigError(
                f"scene {scene!r} is not below the data root {root}",
                where=where,
                todo=f"scenes there: {list_some(there, 12) or 'none'}",
            )
        found[scene] = path.resolve()
    return found


def _make_task(
    spec: TableSpec,
    job: Job,
    found: Resolved,
    folder: Path | None,
    reading: Settings,
    runs: Path,
    workshop: Workshop,
) -> Task:
    trouble, column = "", spec.columns[job.column]
    try:
        data = workshop.hash_data(spec.kind, folder, reading, found.config)
    except SceneError as error:
        # Its run fails with the same words and does not stop the others; once mended it is another run.
        trouble, data = str(error), f"cannot be read: {error}"
    except ConfigError as error:
        raise _within(_place(spec, column), error) from error
    settings = as_plain(found.config)
    scene = job.scene if folder is None or column.root == BUILT_IN else folder.name
    identity = {
        "kind": spec.kind,
        "method": found.name,
        "budget": found.budget,
        "settings": settings,
        "seed": job.seed,
        "scene": scene,
        "reading": reading,
        "data": data,
    }
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    name = f"{found.name}-{scene}-{job.views}-s{job.seed}"
    run_dir = runs.resolve() / f"{re.sub(r'[^A-Za-z0-9_.+-]+', '_', name).strip('.')}-{digest[:12]}"
    content = {
        "method": found.name,
        "data": None if folder is None else str(folder),
        **reading,
        "seed": job.seed,
        "device": workshop.device,
        "budget": found.budget,
        "settings": settings,
    }
    argv = ("--config", str(beside(run_dir, ".yaml")), "--out", str(run_dir), "--quiet", "--no-report")
    steps = settings.get("steps", 0) if isinstance(settings, dict) else 0
    label = f"{spec.rows[job.row].label}, {scene}, {job.views} views, seed {job.seed}"
    module = workshop.modules[spec.kind]
    return Task(run_dir, module, argv, content, int(steps or 0), label, found.name, trouble)
