"""From a table to its jobs: every setting resolved and every scene found before anything runs.

A job's run directory is named after a hash of its resolved settings, seed and data, so that the same run is found
again by any table, and a changed setting or photograph makes another run.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.protocol import Fact, facts_of_settings, refuse_mixture
from visdom_plugin.tables.results import Job, Outcome
from visdom_plugin.tables.spec import BUILT_IN, Column, Row, TableSpec, nest
from visdom_plugin.tables.state import beside
from visdom_plugin.training.files import write_bytes
from visdom_plugin.training.settings import as_plain, from_plain

log = logging.getLogger(__name__)

WHOLE, PIECE = 1 << 20, 1 << 16
"""Bytes: files up to WHOLE are hashed whole, longer ones by their size, first and last PIECE."""


@dataclass(frozen=True)
class Resolved:
    """A row's method, found."""

    name: str
    """The method's own name, aliases resolved."""
    budget: str
    """quick or full."""
    config: Any
    """Settings dataclass of that budget."""


@dataclass(frozen=True)
class Workshop:
    """What commands hand to the tables room."""

    resolve: Callable[[str, str, str], Resolved | None]
    """(kind, method, budget) to the method's settings; None where no such method is installed."""
    modules: Mapping[str, str]
    """Kind to the module whose `main(argv) -> exit status` does such a job."""
    built_in_hash: Callable[[], str]
    """A hash of what the built-in scene is made of."""
    reading: Any = None
    """Dataclass of the options on how scenes are read, to check a column's `reading` against."""
    device: str = "auto"


@dataclass(frozen=True)
class Task:
    """One run directory to make. Several jobs may share it."""

    run_dir: Path
    module: str
    argv: tuple[str, ...]
    content: dict[str, Any] = field(repr=False, default_factory=dict)
    """What its settings file holds."""
    steps: int = 0
    """Length of its schedule, where known."""
    label: str = ""
    """For the user."""
    method: str = ""
    """What tasks of about the same duration have in common."""

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


def plan(spec: TableSpec, runs: Path, workshop: Workshop, roots: Mapping[str, Path] | None = None) -> Plan:
    """All jobs of a table.

    Args:
        runs: folder of run directories.
        roots: name to folder of data roots.

    Raises:
        ConfigError: for a setting that a row's method does not have or that is out of range (naming the row), a
            root that is no folder, a scene that is not in it, and a mixture of protocols.
    """
    resolved = [_resolve(spec, row, workshop) for row in spec.rows]
    for column in spec.columns:
        if workshop.reading is not None:
            from_plain(workshop.reading, column.reading, f"column {column.label!r} of {spec.source}")
    refuse_mixture(_facts(spec, resolved), spec.varies, spec.source)
    folders = [_find_scenes(spec, column, dict(roots or {})) for column in spec.columns]
    found = {path for scenes in folders if scenes for path in scenes.values() if path is not None}
    if found:
        log.info("looking at the files of %d scenes", len(found))
    hashes: dict[Path | None, str] = {}
    jobs: dict[Job, Outcome] = {}
    tasks: dict[Path, Task] = {}
    for i, row in enumerate(spec.rows):
        for j, column in enumerate(spec.columns):
            for scene in column.scenes:
                for views in column.views:
                    for seed in spec.seeds:
                        job = Job(i, j, scene, views, seed)
                        if resolved[i] is None:
                            jobs[job] = Outcome("not available")
                        elif folders[j] is None:
                            jobs[job] = Outcome("no data")
                        else:
                            path = folders[j][scene]
                            if path not in hashes:
                                hashes[path] = workshop.built_in_hash() if path is None else hash_folder(path)
                            task = _make_task(
                                spec, row, column, job, resolved[i], path, hashes[path], runs, workshop
                            )
                            task = tasks.setdefault(task.run_dir, task)
                            jobs[replace(job, run_dir=task.run_dir, argv=task.argv)] = Outcome("waiting")
    return Plan(spec, jobs, tasks)


def hash_folder(folder: Path) -> str:
    """A hash of a scene's files: names, sizes and contents; of files over a megabyte, both ends.

    Hidden files and folders are left out. Photographs are compressed: a changed one changes its size or its ends.
    """
    digest = hashlib.sha256()
    for base, names, files in os.walk(folder):
        names[:] = sorted(n for n in names if not n.startswith("."))
        for name in sorted(f for f in files if not f.startswith(".")):
            path = Path(base) / name
            try:
                with path.open("rb") as file:
                    size = os.fstat(file.fileno()).st_size
                    digest.update(f"{path.relative_to(folder).as_posix()}\0{size}\0".encode())
                    if size <= WHOLE:
                        digest.update(file.read())
                    else:
                        digest.update(file.read(PIECE))
                        file.seek(-PIECE, os.SEEK_END)
                        digest.update(file.read())
            except OSError as error:
                raise ConfigError(
                    f"a file of the scene cannot be read: {error.strerror}", where=path
                ) from error
    return digest.hexdigest()


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
        raise ConfigError(
            error.what, where=f"{where} ({error.where})", cause=error.cause, todo=error.todo
        ) from error


def _facts(spec: TableSpec, resolved: list[Resolved | None]) -> list[Fact]:
    facts: list[Fact] = [("downscale", c.downscale, f"column {c.label!r}") for c in spec.columns]
    for row, found in zip(spec.rows, resolved, strict=True):
        if found is not None:
            owner = f"row {row.label!r}"
            facts.append(("budget", found.budget, owner))
            facts += [(k, v, owner) for k, v in facts_of_settings(as_plain(found.config), spec.kind).items()]
    return facts


def _find_scenes(spec: TableSpec, column: Column, roots: dict[str, Path]) -> dict[str, Path | None] | None:
    """Scene name to folder (None for the built-in scene); None, with a warning, where the root is not here."""
    if column.root == BUILT_IN:
        return {BUILT_IN: None}
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
    where = f"column {column.label!r} of {spec.source}"
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
                todo=f"scenes there: {', '.join(there[:12]) or 'none'}",
            )
        found[scene] = path.resolve()
    return found


def _make_task(
    spec: TableSpec,
    row: Row,
    column: Column,
    job: Job,
    found: Resolved,
    folder: Path | None,
    data_hash: str,
    runs: Path,
    workshop: Workshop,
) -> Task:
    settings = as_plain(found.config)
    scene = folder.name if folder is not None else job.scene
    reading = {"views": job.views, "downscale": column.downscale, "data_format": column.data_format}
    reading |= column.reading
    identity = {
        "kind": spec.kind,
        "method": found.name,
        "budget": found.budget,
        "settings": settings,
        "seed": job.seed,
        "scene": scene,
        "reading": reading,
        "data": data_hash,
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
    argv = ("--config", str(beside(run_dir, ".yaml")), "--out", str(run_dir), "--quiet")
    steps = settings.get("steps", 0) if isinstance(settings, dict) else 0
    label = f"{row.label}, {scene}, {job.views} views, seed {job.seed}"
    return Task(run_dir, workshop.modules[spec.kind], argv, content, int(steps or 0), label, found.name)
