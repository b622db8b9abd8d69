"""visdom-eval --leave-one-out: measures a method where there are no photographs to test on.

Each training view in turn is held out: hull, bounds, normalisation, start and training are made without it, then
it is rendered and measured. Each of these runs has a run directory of its own, which resumes.

<out>/<view>/                  the run without that view; it is the run's only test view
<out>/leave_one_out.json       metrics of each view, mean and worst
<out>/leave_one_out.png        truth, render and error of each view
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from visdom_plugin.cli import options
from visdom_plugin.cli.early import WORD, read_early
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.errors import ConfigError, EmptyHullError, SceneError

if TYPE_CHECKING:
    import numpy as np

    from visdom_plugin.scene import Scene

log = logging.getLogger(__name__)

DEFAULT_METHOD = "3dgs-go+vd"
COLUMNS = (
    ("psnr", "PSNR dB", 2),
    ("psnr_foreground", "in mask dB", 2),
    ("ssim", "SSIM", 4),
    ("silhouette_iou", "IoU", 4),
    ("outside_hull_mass", "off hull", 4),
    ("lpips", "LPIPS", 4),
)
"""Metrics of the table on the terminal, heads and decimals."""
FAILURES = 1
"""Exit status when a run failed."""
PROG = "visdom-eval --leave-one-out"


class Worst(TypedDict):
    """The worst view of a metric."""

    view: str
    value: float


class Averages(TypedDict):
    """What the folds come to; None where no view has a metric."""

    mean: dict[str, float | None]
    worst: dict[str, Worst | None]
    per_view: dict[str, dict[str, float | None]]


class Summary(Averages):
    """leave_one_out.json's content."""

    method: str
    scene: str
    seed: int
    budget: str
    views: list[str]
    """The views held out."""
    config: dict[str, object]
    runs: dict[str, str]
    """View to the run directory without it."""
    failed: dict[str, str]
    """View to why the run without it failed."""


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit status."""
    early = read_early(argv)
    named = bool(early.methods or early.config)
    request = options.parse(argv if named else [*argv, WORD + DEFAULT_METHOD], prog=PROG)
    common = request.common
    if common.show_config:
        sys.stdout.write(options.dump(request))
        return 0
    load_torch()
    device = options.resolve_device(common.device)

    from visdom_plugin.cli.scenes import open_scene

    scene = open_scene(common.data, **options.read_options(common), fill=False, hold_out=False)
    check_views(scene, request.config)
    folder = common.out or default_folder(scene, request.preset.name, common.seed)
    if not common.quiet:
        count = len(held_out_views(scene))
        note = "" if named else " (method:NAME chooses another method)"
        say(
            f"{request.preset.name}{note} on {scene.name}: {count} runs, each without one view, {request.note}"
        )
        say(f"results: {folder}")
    summary = run_folds(request, scene, folder, device=device)
    if not common.quiet:
        show_summary(summary, folder)
    return FAILURES if summary["failed"] else 0


def default_folder(scene: Scene, method: str, seed: int) -> Path:
    """runs/<scene>/<views>/<method>/<seed>-leave-one-out."""
    from visdom_plugin.cli.runs import default_run_dir

    return default_run_dir(scene.name, len(scene.train), method, seed).with_name(f"{seed}-leave-one-out")


def held_out_views(scene: Scene) -> list[int]:
    """Positions of the training views that can be measured on: those whose mask was given."""
    return [i for i in range(len(scene.train)) if scene.train.mask_origin(i) == "given"]


def check_views(scene: Scene, config: object) -> None:
    """Refuses scenes and hulls that leave nothing once a view is held out; hints where little is left.

    Raises:
        SceneError: fewer than three views with a mask.
        ConfigError: K is above the number of views left.
    """
    views = len(held_out_views(scene))
    if views < 3:
        raise SceneError(
            f"leave-one-out needs at least 3 training views with a mask, and there are {views}",
            where=scene.name,
            cause="without one of them, a single view would be left to carve with" if views == 2 else None,
            todo="pass --views with 3 or more, or take another photograph",
        )
    hull, left = getattr(config, "hull", None), views - 1
    k = getattr(hull, "k", None)
    if getattr(hull, "kind", None) != "visdom" or not isinstance(k, int):
        return
    if k > left:
        raise ConfigError(
            f"K = {k}, but {left} views are left when one of {views} is held out: no space is seen by {k} of them",
            where="--k",
            todo=f"pass --k {left}, or more --views",
        )
    if k == left:
        log.info(
            "K = %d of the %d views left: space must be seen by every one of them; with --k %d the "
            "hulls are closer to that of all %d views",
            k, left, max(k - 1, 1), views,
        )  # fmt: skip


def run_folds(request: options.Request, scene: Scene, folder: Path, *, device: str) -> Summary:
    """Makes, or finds, the run without each view, and writes what they come to.

    A run that fails does not stop the others: what its training diverged on, or what its hull was empty of, may be
    due to the view that it goes without.

    Args:
        scene: with all views, masks not filled in yet.

    Returns:
        leave_one_out.json's content.

    Raises:
        SceneError: views lack masks that nobody may fill in.
        ConfigError, CheckpointError, PluginError: settings, folder or method will not do, with or without a view.
    """
    from visdom_plugin.atomic_files import write_json
    from visdom_plugin.cli.runs import train_as_asked
    from visdom_plugin.figures.contact_sheet import draw_sheet, picture_names, write_png
    from visdom_plugin.scene import hold_out
    from visdom_plugin.training.missing_masks import fill_masks
    from visdom_plugin.training.runs.config_io import as_plain
    from visdom_plugin.training.trainer import TrainingError

    common = request.common
    held = held_out_views(scene)
    names = picture_names(scene.train.names)
    records, failed, columns = {}, {}, []
    if common.missing_masks == "error":
        # A view that has no mask is held out of no run.
        fill_masks(hold_out(scene, held[0]), "error")
    for number, i in enumerate(held, start=1):
        name = scene.train.names[i]
        if not common.quiet:
            say(f"{number} of {len(held)}: without {name}")
        try:
            fold = fill_masks(hold_out(scene, i), common.missing_masks)
            records[name] = train_as_asked(request, fold, folder / names[i], device)
        except (EmptyHullError, SceneError, TrainingError) as error:
            failed[name] = str(error)
            log.warning("the run without %s failed: %s", name, error)
            continue
        columns.append(_column(fold, records[name], folder / names[i]))
    if columns:
        write_png(folder / "leave_one_out.png", draw_sheet(columns, ["truth", "render", "error"]))
    summary: Summary = {
        "method": request.preset.name,
        "scene": scene.name,
        "seed": common.seed,
        "budget": common.budget,
        "views": [scene.train.names[i] for i in held],
        "config": as_plain(request.config),
        **summarise({name: record["metrics"]["per_view"][name] for name, record in records.items()}),
        "runs": {scene.train.names[i]: names[i] for i in held},
        "failed": failed,
    }
    write_json(folder / "leave_one_out.json", summary)
    return summary


def summarise(per_view: dict[str, dict[str, float | None]]) -> Averages:
    """Mean and worst view of each metric; None where no view has it."""
    from visdom_plugin.tables.measures import MEASURES
    from visdom_plugin.training.metrics import NAMES

    mean: dict[str, float | None] = {}
    worst: dict[str, Worst | None] = {}
    for name in NAMES:
        values = {view: value for view, row in per_view.items() if (value := row.get(name)) is not None}
        mean[name] = sum(values.values()) / len(values) if values else None
        choose = min if MEASURES[name].higher_is_better else max
        view = choose(values, key=values.__getitem__) if values else None
        worst[name] = None if view is None else {"view": view, "value": values[view]}
    return {"mean": mean, "worst": worst, "per_view": per_view}


def show_summary(summary: Summary, folder: Path) -> None:
    """The table on the terminal."""
    from rich.console import Console
    from rich.table import Table

    from visdom_plugin.cli.output.terminal import show_files

    console = Console(soft_wrap=True)
    shown = [column for column in COLUMNS if summary["mean"].get(column[0]) is not None] or COLUMNS[:1]
    count = (
        f"{len(summary['per_view'])} of {len(summary['views'])} views" if summary["failed"] else "each view"
    )
    table = Table(title=f"{summary['method']} on {summary['scene']}, {count} held out in turn")
    table.add_column("held out")
    for _, head, _ in shown:
        table.add_column(head, justify="right")

    def spell(values: dict[str, float | None]) -> list[str]:
        return ["-" if (v := values.get(key)) is None else f"{v:.{digits}f}" for key, _, digits in shown]

    for name, row in summary["per_view"].items():
        table.add_row(name, *spell(row))
    for name in summary["failed"]:
        table.add_row(name, *["failed"] * len(shown))
    table.add_section()
    table.add_row("mean", *spell(summary["mean"]))
    table.add_row("worst", *spell({k: w and w["value"] for k, w in summary["worst"].items()}))
    console.print(table)
    show_files(folder, (("sheet", "leave_one_out.png"), ("numbers", "leave_one_out.json")))


def _column(fold: Scene, record: dict[str, Any], run_dir: Path) -> tuple[str, list[np.ndarray]]:
    """Title, truth, render and error of a run's one test view."""
    from visdom_plugin.figures.contact_sheet import draw_error, picture_names, read_png, to_bytes
    from visdom_plugin.training.metrics import whiten

    (name,) = fold.test.names
    truth = to_bytes(whiten(fold.test.images[0], fold.test.masks[0]))
    render = read_png(run_dir / "renders" / "test" / f"{picture_names([name])[0]}.png")
    error = draw_error(truth, render)
    ignored = fold.test.ignored(0)
    if ignored is not None:
        truth[ignored.numpy()], error[ignored.numpy()] = 128, 128
    psnr = record["metrics"]["per_view"][name]["psnr"]
    return f"{name}  {psnr:.1f} dB", [truth, render, error]
