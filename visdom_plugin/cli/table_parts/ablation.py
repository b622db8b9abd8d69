"""visdom-table ablation: one method on one scene, bare, with the mask loss, and with each kind of hull.

All variants share seed, data and schedule, so that what differs between them is what they name. Writes the usual
table files, and ablation.png: a row per variant, with its renders of a few views and bars of its numbers.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from datamodules.built_in import PREFIX
from visdom_plugin import registry
from visdom_plugin.cli.early import WORD, read_early
from visdom_plugin.cli.options import Common, Request, choose_budget, name_method, resolve_device
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.cli.table_parts.run_table import (
    TableOptions,
    change_spec,
    find_folders,
    find_rows,
    run_spec,
)
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.tables.results import Job, Outcome, Results
from visdom_plugin.tables.spec import Column, Row, Settings, TableSpec, flatten, nest
from visdom_plugin.training.runs.config_io import as_plain, from_plain

if TYPE_CHECKING:
    from visdom_plugin.scene import Scene, Views

NAME = "ablation"
DEFAULT_METHOD = "ingp"
VARIANTS: tuple[tuple[str, str, Settings], ...] = (
    ("vanilla", "", {}),
    ("+mask", "+mask", {}),
    ("+unit sphere", "+vd", {"hull.kind": "unit-sphere"}),
    ("+traditional hull", "+vd", {"hull.kind": "traditional"}),
    ("+vd", "+vd", {}),
)
"""Labels, suffixes of the method's name, settings."""
NAMED = ("hull.kind", "vd.enabled", "mask_weight")
"""Settings that the variants' labels speak of."""
METRICS = ("psnr", "ssim", "silhouette_iou", "outside_hull_mass")
VIEWS_SHOWN = 3


@dataclass(frozen=True)
class AblationOptions(TableOptions):
    """Paired ablation of one method (method:NAME, by default ingp) on your own scene.

    Vanilla, with the mask loss, and with the hook in the traditional hull within a ball, the whole traditional
    hull and the visible domain, with the same seed, data and schedule:

    visdom-table ablation method:3dgs-go --data DIR --views 4
    """

    set: tuple[str, ...] = ()
    """Settings of all variants, as PATH=VALUE, e.g. steps=400 hull.resolution=128."""
    leave_one_out: bool = False
    """For scenes without test views: hold out each training view in turn and measure on it."""


def ablation(argv: Sequence[str]) -> int:
    """The command; returns the exit status."""
    early = read_early(argv)
    named = name_method(early)
    options = tyro.cli(AblationOptions, args=early.rest, prog=f"visdom-table {NAME} [{WORD}{DEFAULT_METHOD}]")
    if options.table not in (None, NAME):
        raise ConfigError(
            f"{WORD}{named} goes with the table {NAME!r} alone, not with {options.table!r}",
            where="the command line",
            todo=f"leave out {WORD}{named}, or make the {NAME}: visdom-table {NAME} {WORD}{named}",
        )
    if options.edition is not None:
        raise ConfigError(f"the {NAME} has no editions", where=f"--edition {options.edition}")
    spec = make_spec(named or DEFAULT_METHOD, options)
    out, runs = find_folders(spec, options)
    scene = _open(spec, options)
    if options.leave_one_out:
        return _run_folds(spec, scene, options, out, runs)
    if not len(scene.test):
        raise SceneError(
            "this scene has no test views to measure on",
            where=options.data,
            todo="pass --leave-one-out: each training view is measured by what is made without it",
        )
    status, results = run_spec(spec, options)
    if results is not None:
        for views in spec.columns[0].views:
            _draw(results, views, scene.test, out, options.quiet)
    return status


def make_spec(method: str, options: AblationOptions) -> TableSpec:
    """The table of a method's five variants.

    Raises:
        ConfigError: for a method without the variants +mask and +vd, a setting that is not PATH=VALUE, and one
            that would make a variant something else than its label says.
    """
    base = registry.find(method).name
    known = registry.installed().presets
    missing = [base + suffix for suffix in ("+mask", "+vd") if base + suffix not in known]
    if missing:
        able = [name for name in known if {name + "+mask", name + "+vd"} <= known.keys()]
        raise ConfigError(
            f"method:{method} has no variant {' and '.join(missing)} to compare with",
            todo=f"choose one of: {', '.join(WORD + name for name in able)}",
        )
    shared = _read_settings(options.set)
    rows = tuple(Row(label, base + suffix, {**own, **shared}) for label, suffix, own in VARIANTS)
    # A hull's settings are none of the variants that have no hull.
    rows = tuple(replace(row, settings=_fitting(row, known[row.method])) for row in rows)
    spec = TableSpec(
        name=f"{NAME}-{base}"
        + ("" if options.data is None else f"-{options.data.resolve().name.removeprefix(PREFIX)}"),
        title=f"Paired ablation of {base}",
        rows=rows,
        columns=(Column("built-in"),),
        metrics=METRICS,
        varies=("hull.kind",),
        source=f"visdom-table {NAME}",
    )
    return change_spec(spec, options)


def _read_settings(words: Sequence[str]) -> Settings:
    import yaml

    found: Settings = {}
    for word in words:
        path, equals, value = word.partition("=")
        if not (path and equals and value):
            raise ConfigError(f"--set {word} is not PATH=VALUE", todo="e.g. --set steps=400")
        try:
            given = flatten({path: yaml.safe_load(value)})
        except (yaml.YAMLError, ValueError) as error:
            raise ConfigError(f"--set {word}: {value!r} is no value") from error
        for name in NAMED:
            if any(name == p or name.startswith(f"{p}.") for p in given):
                raise ConfigError(
                    f"{name} is what the variants differ in; it cannot be the same for all of them",
                    where=f"--set {word}",
                    todo="write a table file to compare other variants; see docs/tables.md",
                )
        found |= given
    return found


def _fitting(row: Row, preset: registry.Preset) -> Settings:
    bare = getattr(preset.quick, "hull", None) is None
    return {k: v for k, v in row.settings.items() if not (bare and k.startswith("hull."))}


def _open(spec: TableSpec, options: AblationOptions) -> Scene:
    """The scene whose views the figure shows: at the first number of views, with the first seed."""
    load_torch()
    from visdom_plugin.cli.scenes import open_scene

    column, folds = spec.columns[0], options.leave_one_out
    return open_scene(
        options.data,
        views=column.views[0],
        downscale=column.downscale,
        seed=spec.seeds[0],
        fill=not folds,
        hold_out=not folds,
    )


def _run_folds(spec: TableSpec, scene: Scene, options: AblationOptions, out: Path, runs: Path) -> int:
    """The same table with every training view held out in turn; the views stand as the table's scenes."""
    from visdom_plugin.cli.evaluation import leave_one_out as folds
    from visdom_plugin.tables.report.write import write_all
    from visdom_plugin.training.runs.run_directory import read_record

    column, only = spec.columns[0], find_rows(spec, options.only)
    alone = options.executor in (None, "process") and options.workers is None and not options.dry_run
    if len(column.views) > 1 or len(spec.seeds) > 1 or not alone:
        raise ConfigError(
            "--leave-one-out goes with one number of views, one seed and this process",
            todo="leave out --executor, --workers and --dry-run, and give one --views and --seeds",
        )
    budget, note = choose_budget(spec.budget, options.device)
    common = Common(
        data=options.data,
        views=column.views[0],
        downscale=column.downscale,
        seed=spec.seeds[0],
        budget=budget,
        quiet=options.quiet,
    )
    device = resolve_device(options.device)
    requests = [_request(row, budget, common, note) for row in spec.rows]
    for request in requests:
        folds.check_views(scene, request.config)
    names = tuple(scene.train.names[i] for i in folds.held_out_views(scene))
    spec = replace(spec, columns=(replace(column, scenes=names, label=f"{scene.name}, each view held out"),))
    outcomes: dict[Job, Outcome] = {}
    for i, (row, request) in enumerate(zip(spec.rows, requests, strict=True)):
        folder = runs / _name_of(row, request)
        runs_of, failed = {}, {}
        if only is None or i in only:
            if not options.quiet:
                say(f"{row.label}: {row.method}")
            summary = folds.run_folds(request, scene, folder, device=device)
            runs_of, failed = summary["runs"], summary["failed"]
        for name in names:
            run_dir = folder / runs_of.get(name, "")
            outcome = Outcome("waiting")
            if name in failed:
                outcome = Outcome("failed", error=failed[name])
            elif name in runs_of:
                outcome = Outcome("finished", record=read_record(run_dir))
            outcomes[Job(i, 0, name, column.views[0], spec.seeds[0], run_dir)] = outcome
    results = Results(spec, outcomes)
    write_all(results, out)
    _draw(results, column.views[0], scene.train, out, options.quiet)
    if not options.quiet:
        sys.stdout.write((out / "table.md").read_text(encoding="utf-8"))
    return 1 if any(o.status == "failed" for o in outcomes.values()) else 0


def _name_of(row: Row, request: Request) -> str:
    """A folder for the row's runs; another one for other settings."""
    common = as_plain(request.common)
    identity = [as_plain(request.config), *(common[k] for k in ("data", "views", "downscale", "seed"))]
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return f"{row.method}-{row.label.strip('+').replace(' ', '-')}-without-one-{digest[:12]}"


def _request(row: Row, budget: str, common: Common, note: str) -> Request:
    preset = registry.find(row.method)
    where = f"row {row.label!r}"
    config = from_plain(preset.settings(budget), nest(row.settings, where), where)
    return Request(preset, config, common, note)


def _draw(results: Results, views: int, photographs: Views, out: Path, quiet: bool) -> None:
    """Writes the figure of one number of views, seed by seed averaged numbers, the first seed's pictures."""
    from visdom_plugin.cli.table_parts.ablation_figure import draw_figure
    from visdom_plugin.figures.contact_sheet import write_png

    several = len(results.spec.columns[0].views) > 1
    path = out / (f"{NAME}-{views}.png" if several else f"{NAME}.png")
    write_png(path, draw_figure(results, views, photographs, VIEWS_SHOWN))
    if not quiet:
        say(f"figure: {path}")
