"""Runs a table as the command line asks: its options, what they change of the file, folders, executor."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from datamodules.built_in import DEFAULT, named_built_in, on_disk
from visdom_plugin.cli.options import resolve_device
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.errors import ConfigError, unknown_name
from visdom_plugin.tables.results import Results
from visdom_plugin.tables.spec import BUILT_IN, Column, TableSpec, check_spec

if TYPE_CHECKING:
    from visdom_plugin.tables.run.executors import Executor
    from visdom_plugin.tables.run.jobs import Plan

FAILURES = 1
"""Exit status of a table with failed runs."""


@dataclass(frozen=True)
class TableOptions:
    """Run a table: every row (method) on every scene and number of views of every column, once per seed.

    Finished runs are reused, interrupted ones resumed; failed ones show their error in the table and do not stop
    the rest. Writes table.md, .csv, .tex and .html whenever a run ends. Exits with 1 when runs failed.

    The table `ablation` is made for one method and your scene: visdom-table ablation method:ingp --data DIR
    """

    table: tyro.conf.Positional[str | None] = None
    """Name of a shipped table or a YAML file, with `:EDITION` where wanted; without it, the shipped ones are
    listed."""
    edition: str | None = None
    """Edition of the table, e.g. smoke."""
    out: Path | None = None
    """Folder of the table; by default tables/<name>, or tables/<name>-<edition>."""
    runs: Path | None = None
    """Folder of run directories; by default `runs` in the table's folder. Tables with the same one share
    their runs."""
    root: tuple[str, ...] = ()
    """Data roots as NAME=DIR, for each root the table names; or set VISDOM_ROOT_<NAME>."""
    data: Path | None = None
    """Run the rows on this scene in place of the table's columns."""
    views: tuple[int, ...] = ()
    """Numbers of training views in place of the table's."""
    downscale: float | None = None
    """In place of the table's."""
    seeds: tuple[int, ...] = ()
    """In place of the table's."""
    only: tuple[str, ...] = ()
    """Labels of the rows to run; other rows show results that exist already."""
    budget: Literal["auto", "quick", "standard", "full"] | None = None
    """In place of the table's."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on; auto takes CUDA where available."""
    executor: Literal["process", "local", "slurm"] | None = None
    """This process; `--workers` processes of this machine (the default with --workers); or a Slurm cluster."""
    workers: int | None = None
    """Number of runs at a time on this machine, which share its cores."""
    slurm: Path | None = None
    """YAML file of Slurm's resources; its entries win over the table's `slurm:`."""
    retry: bool = False
    """Retry failed runs."""
    dry_run: bool = False
    """List the runs and which of them are done, and exit."""
    quiet: bool = False
    """Print nothing but errors."""


def run_spec(spec: TableSpec, options: TableOptions) -> tuple[int, Results | None]:
    """Runs a table as the options say.

    Returns:
        the exit status, and what there is of the runs; None in place of it when they were only listed, where the
        status is 1 for scenes that cannot be read.
    """
    load_torch()
    from visdom_plugin.cli.table_parts.workshop import make_workshop
    from visdom_plugin.tables.report.summary import summarise
    from visdom_plugin.tables.report.write import write_all
    from visdom_plugin.tables.run.driver import gather, look, run_plan
    from visdom_plugin.tables.run.job_files import remove_old_parts
    from visdom_plugin.tables.run.jobs import plan
    from visdom_plugin.tables.run.progress import Overview

    only = find_rows(spec, options.only)
    folder, runs = find_folders(spec, options)
    # Refuses metrics, layouts and places in the paper that are not there.
    summarise(Results(spec))
    workshop = make_workshop(options.device, options.executor)
    made = plan(spec, runs, workshop, _read_roots(spec, options), only)
    overview = Overview(quiet=options.quiet)
    executor = _make_executor(spec, options, runs, overview.tick)
    if options.executor != "slurm" and not options.dry_run:
        resolve_device(options.device)  # once here, not in every run
    if options.dry_run:
        sys.stdout.write("\n".join(describe_plan(made)) + "\n")
        troubles = dict.fromkeys(task.trouble for task in made.tasks.values() if task.trouble)
        for trouble in troubles:
            say(f"error: {trouble}")
        return FAILURES if troubles else 0, None
    for place in (folder, runs):
        _make_folder(place)
        remove_old_parts(place)
    run_plan(
        made,
        executor,
        lambda results: write_all(results, folder),
        retry=options.retry,
        only=only,
        overview=overview,
    )
    results = gather(made, look(made))
    failed = sum(outcome.status == "failed" for outcome in results.outcomes.values())
    if not options.quiet:
        markdown = folder / "table.md"
        if markdown.exists():
            sys.stdout.write(markdown.read_text(encoding="utf-8"))
        if failed:
            say(
                f"{failed} of {len(results.outcomes)} runs failed; add --retry to the command to run them again"
            )
        for path in sorted(folder.glob("table*.*")):
            say(f"written: {path}")
    return FAILURES if failed else 0, results


def find_rows(spec: TableSpec, labels: Sequence[str]) -> list[int] | None:
    """Positions of the rows that --only names; None where it names none, which is all of them.

    Raises:
        ConfigError: for a row that is not there.
    """
    known = [row.label for row in spec.rows]
    for label in labels:
        if label not in known:
            raise unknown_name(f"there is no row {label!r}", label, known, where="--only", todo="rows")
    return [known.index(label) for label in labels] or None


def find_folders(spec: TableSpec, options: TableOptions) -> tuple[Path, Path]:
    """The table's folder and that of its runs, neither of which need be there yet.

    Raises:
        ConfigError: when one of them is a file, or would lie below one.
    """
    folder = options.out or Path("tables") / spec.folder_name
    runs = options.runs or folder / "runs"
    for what, option, path in (("table", "--out", folder), ("runs", "--runs", runs)):
        for place in (path, *path.parents):
            if place.exists() and not place.is_dir():
                said = "is a file" if place == path else f"cannot be made: {place} is a file"
                raise ConfigError(
                    f"the folder of the {what} {said}", where=path, todo=f"choose another {option}"
                )
    return folder, runs


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"the folder cannot be made: {error.strerror}", where=path, todo="choose another --out or --runs"
        ) from error


def change_spec(spec: TableSpec, options: TableOptions) -> TableSpec:
    """The table with what the command line puts in its place."""
    columns = spec.columns
    if options.data is not None:
        built_in, folder = named_built_in(options.data), on_disk(options.data)
        if folder is not None and not folder.expanduser().is_dir():
            raise ConfigError(
                f"there is no folder {options.data}", where="--data", todo="name a scene's folder"
            )
        views = options.views or columns[0].views
        columns = (
            Column(built_in, BUILT_IN, (BUILT_IN if built_in == DEFAULT else built_in,), views)
            if built_in
            else Column(options.data.resolve().name, "data", (".",), views),
        )
    if options.views:
        columns = tuple(replace(column, views=options.views) for column in columns)
    if options.downscale is not None:
        columns = tuple(replace(column, downscale=options.downscale) for column in columns)
    changed = replace(
        spec, columns=columns, seeds=options.seeds or spec.seeds, budget=options.budget or spec.budget
    )
    check_spec(changed, "the command line")
    return changed


def describe_plan(made: Plan) -> list[str]:
    """One line per job: what would become of it."""
    from visdom_plugin.tables.run.driver import gather, look
    from visdom_plugin.tables.run.job_files import is_held, read_step

    lines, seen = [], set()
    for job, outcome in gather(made, look(made)).outcomes.items():
        word = {"finished": "reuse", "waiting": "run"}.get(outcome.status, outcome.status)
        if job.run_dir is not None:
            if job.run_dir in seen:
                word = "shared"
            elif made.tasks[job.run_dir].trouble and outcome.status != "finished":
                word = "cannot run"
            elif outcome.status == "waiting" and is_held(job.run_dir):
                word = "running"
            elif outcome.status == "waiting" and (step := read_step(job.run_dir)):
                word = f"resume from {step}"
            seen.add(job.run_dir)
        row, column = made.spec.rows[job.row], made.spec.columns[job.column]
        where = "" if job.run_dir is None else f"  {job.run_dir}"
        lines.append(
            f"{word:<16} {row.label} | {column.label} | {job.scene} | {job.views} | {job.seed}{where}"
        )
    todo = len(made.tasks) - sum(o.status == "finished" for o in look(made).values())
    jobs, runs = (
        f"{n} {what}{'s' * (n != 1)}" for n, what in ((len(lines), "job"), (len(made.tasks), "run"))
    )
    return [*lines, f"{jobs}, {runs}, {todo} of them not finished"]


def _read_roots(spec: TableSpec, options: TableOptions) -> dict[str, Path]:
    roots, known = {}, sorted({column.root for column in spec.columns} - {BUILT_IN, "data"})
    for text in options.root:
        name, equals, folder = text.partition("=")
        if not (name and equals and folder):
            raise ConfigError(f"--root {text} is not NAME=DIR", todo="e.g. --root mip360=/data/mip360")
        if name not in known and (options.data is not None or name != "data"):
            what = f"the table has no data root {name!r}"
            raise (
                unknown_name(what, name, known, where=f"--root {text}", todo="roots")
                if known
                else ConfigError(what, where=f"--root {text}", todo="leave it out")
            )
        roots[name] = Path(folder)
    if (data := on_disk(options.data)) is not None:
        roots["data"] = data
    return roots


def _make_executor(spec: TableSpec, options: TableOptions, runs: Path, tick: Callable[[], None]) -> Executor:
    from visdom_plugin.tables.run.executors import Here, Local
    from visdom_plugin.tables.run.slurm import Slurm, read_config

    kind = options.executor or ("process" if options.workers is None else "local")
    if options.workers is not None and kind != "local":
        what = f"--workers {options.workers} does not go with the executor {kind!r}"
        raise ConfigError(what, todo="leave out --workers, or take --executor local")
    if options.workers is not None and options.workers < 1:
        raise ConfigError(f"--workers is {options.workers}", todo="use 1 or more, or leave it out")
    resources = read_config(spec, options.slurm)
    if kind == "process":
        return Here(tick)
    return Local(options.workers or 1) if kind == "local" else Slurm(resources, runs)
