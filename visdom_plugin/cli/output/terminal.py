"""Messages on the terminal: one line, or a run's metrics."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

from visdom_plugin.compute.waiting import phase, screen
from visdom_plugin.errors import count_of
from visdom_plugin.tables.measures import MEASURES

ROWS = (
    ("psnr", "PSNR", "dB"),
    ("psnr_per_channel", "PSNR, mean of channels", "dB"),
    ("ssim", "SSIM", ""),
    ("psnr_foreground", "PSNR inside the mask", "dB"),
    ("silhouette_iou", "silhouette IoU", ""),
    ("outside_hull_mass", "opacity outside the hull", ""),
    ("lpips", "LPIPS (VGG)", ""),
)


FILES = (
    ("report", "report.html"),
    ("sheet", "renders/test_sheet.png"),
    ("sheet", "renders/training_sheet.png"),
    ("orbit", "renders/orbit_sheet.png"),
    ("renders", "renders/test"),
    ("export", "export"),
    ("hull", "hull/hull.ply"),
    ("numbers", "run.json"),
)


def say(text: str) -> None:
    """One line for the user, on stderr so that stdout stays for results."""
    screen.clear()
    print(text, file=sys.stderr, flush=True)


def load_torch() -> None:
    """Imports torch, which takes the first second or two of most commands, and says so."""
    if "torch" in sys.modules:
        return
    with phase("loading torch"):
        screen.show()
        import_module("torch")


def show_files(folder: Path, named: Iterable[tuple[str, str]]) -> None:
    """A line for each (label, file in the folder) that is there, on stdout."""
    for label, name in named:
        if (folder / name).exists():
            print(f"{label:>8}: {folder / name}")


def show_next(folder: Path) -> None:
    """What a user may do with a finished run, as commands, on stderr."""
    run = shlex.quote(str(folder))
    page = folder / "report.html"
    say(f"next: open {page}" if page.exists() else f"next: visdom-report {run}")
    say(f"      visdom-view {run}                  # in the browser, beside the photographs")
    say(f"      visdom-render {run} --path orbit   # a flight around it")
    splat = (folder / "export" / "point_cloud.ply").exists()
    form, what = (
        ("html", "one page to send; also glb, obj, spz and more") if splat else ("glb", "a mesh; also obj")
    )
    say(f"      visdom-export {run} --format {form} --upright  # {what}")


def show_oracle(record: dict[str, Any]) -> None:
    """What choosing among the snapshots of a run on its test views would have gained, on stdout."""
    chosen, last = record["selected_on_test"], record["metrics"]["test"]["psnr"]
    best = chosen["by_step"][str(chosen["step"])]["psnr"]
    print(
        f"oracle: {best:.2f} dB after step {chosen['step']}, {best - last:+.2f} dB against the last step; "
        f"SELECTED ON THE TEST SET, the best of {len(chosen['by_step'])} snapshots: not a result of the method"
    )


def show_result(record: dict[str, Any], folder: Path) -> None:
    """The metrics table, the times and where the pictures are."""
    from rich.console import Console
    from rich.table import Table

    console = Console(soft_wrap=True)
    views = len(record["data"]["test"])
    measured = record["metrics"].get("measured_views", views)
    count = ("" if measured == views else f"{measured} of ") + count_of(views, "test view")
    title = f"{record['method']} on {record['scene']}, {count}"
    table = Table(title=title)
    table.add_column("metric")
    table.add_column("mean", justify="right")
    table.add_column("worst view", justify="right")
    means, per_view = record["metrics"]["test"], record["metrics"]["per_view"]
    for key, label, unit in ROWS:
        if means.get(key) is None:
            continue
        values = [row[key] for row in per_view.values() if row[key] is not None]
        worst = min(values) if MEASURES[key].higher_is_better else max(values)
        digits = 2 if unit else 4
        table.add_row(
            label, f"{means[key]:.{digits}f} {unit}".rstrip(), f"{worst:.{digits}f} {unit}".rstrip()
        )
    if measured:
        console.print(table)
    else:
        why = "no test view has a mask of its own"
        if not views:
            trained = len(record["data"]["train"])
            why = f"no view is left to test on: {trained} train. Fewer --views, or --test-list, leave some"
        console.print(f"{title}: nothing is measured, because {why}", highlight=False, markup=False)
    timing = record.get("timing", {})
    if "train_s" in timing:
        console.print(
            f"training {timing['train_s']:.1f} s ({timing['step_ms']:.1f} ms a step), "
            f"hull {timing['hull_s']:.2f} s, evaluation {timing['eval_s']:.1f} s"
        )
    for name, count in record.get("model", {}).items():
        console.print(f"model: {count:,} {name.capitalize()}", highlight=False)
    show_files(folder, FILES)
