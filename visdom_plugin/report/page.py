"""One HTML file on one run, or on several side by side: no server, no network, nothing beside it is needed."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.errors import list_some
from visdom_plugin.report.gather import DATA, FOLDER, state_of
from visdom_plugin.tables.report.svg_figures import draw_curves, pen, read_curve, read_last_step
from visdom_plugin.training.runs.run_directory import read_record

if TYPE_CHECKING:
    from jinja2 import Template

NAME = "report.html"
METRICS = (
    ("psnr", "PSNR", "dB", 2, True),
    ("ssim", "SSIM", "", 4, True),
    ("psnr_foreground", "PSNR inside the mask", "dB", 2, True),
    ("silhouette_iou", "silhouette IoU", "", 4, True),
    ("outside_hull_mass", "opacity outside the hull", "", 4, False),
    ("lpips", "LPIPS (VGG)", "", 4, False),
)
"""Name in run.json, title, unit, digits, and whether more is better."""
_DOWNLOADS = ("*.ply", "*.glb", "*.obj", "*.spz", "*.sog", "*.splat", "*.html")


@dataclass(frozen=True)
class Reported:
    """One run as its folder holds it."""

    path: Path
    label: str
    record: dict[str, Any]
    data: dict[str, Any]


def read_gathered(path: Path) -> dict[str, Any] | None:
    """What `gather` kept of a run, if it is of the run's present state; else None."""
    try:
        data = json.loads((path / FOLDER / DATA).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if data.get("state") == state_of(read_record(path)) else None


def write_page(target: Path, runs: Sequence[Path]) -> Path:
    """Writes the page of runs whose pictures were gathered; returns its path."""
    found = []
    for path in runs:
        data = read_gathered(path)
        if data is None:
            raise FileNotFoundError(f"{path} was not gathered")
        found.append(Reported(path, "", read_record(path), data))
    labels = _labels([run.record for run in found], [run.path for run in found])
    found = [Reported(r.path, label, r.record, r.data) for r, label in zip(found, labels, strict=True)]
    write_bytes(target, to_html(found, target.parent).encode())
    return target


def to_html(runs: Sequence[Reported], folder: Path) -> str:
    """The page.

    Args:
        folder: where it will lie, from which the links to downloads lead.
    """
    from markupsafe import Markup

    series = [(n, r.label, c) for n, r in enumerate(runs) if (c := read_curve(r.path)) is not None]
    marks = _marks(runs)
    scenes = sorted({run.record["scene"] for run in runs})
    title = (
        f"{runs[0].label} on {scenes[0]}" if len(runs) == 1 else f"{len(runs)} runs on {', '.join(scenes)}"
    )
    return _template().render(
        title=title,
        runs=[_run(n, run, folder) for n, run in enumerate(runs)],
        metrics=_metrics(runs),
        places=_places(runs),
        curves=Markup(draw_curves(series, marks)) if series else "",
        marked=_describe_marks(runs, marks),
        several=len(runs) > 1,
        same_data=_same_data(runs),
    )


def _marks(runs: Sequence[Reported]) -> dict[str, list[float]]:
    """What happened at which shares of the schedule, where it is one for all runs."""
    found = []
    for run in runs:
        last = read_last_step(run.path)
        events = run.record.get("events", {}) if last else {}
        found.append({what: [step / last for step in steps] for what, steps in events.items() if steps})
    return found[0] if found and all(marks == found[0] for marks in found) else {}


def _describe_marks(runs: Sequence[Reported], marks: dict[str, list[float]]) -> str:
    """The sentence below the curves; empty where nothing is marked."""
    if not marks:
        return ""
    events = runs[0].record["events"]
    listed = "; ".join(f"{what} after step {list_some(steps, 8)}" for what, steps in events.items() if steps)
    more = " A reset of opacities costs several decibels, which the next steps win back." * (
        "opacities reset" in events
    )
    return f"Dotted: {listed}.{more}"


@lru_cache(maxsize=1)
def _template() -> Template:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("visdom_plugin", "report")
    return Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).get_template("page.html")


def _labels(records: Sequence[dict[str, Any]], paths: Sequence[Path]) -> list[str]:
    """The methods' names, with the seed or the path where they would be the same."""
    names = [r["method"] for r in records]
    for more in (lambda r, _: f"{r['method']}, seed {r['seed']}", lambda r, p: f"{r['method']}, {p}"):
        if len(set(names)) < len(names):
            names = [more(r, p) for r, p in zip(records, paths, strict=True)]
    return names


def _run(n: int, run: Reported, folder: Path) -> dict[str, Any]:
    record, data = run.record, run.data
    timing, reading = record.get("timing", {}), record["data"]
    facts = [
        ("scene", record["scene"]),
        ("data", reading.get("path") or "the built-in scene"),
        ("views", f"{len(reading['train'])} for training, {len(reading['test'])} for testing"),
        ("size", f"reduced by {reading['downscale']:g}" if reading.get("downscale", 1) != 1 else "as it is"),
        ("budget, seed", f"{record.get('budget') or 'not noted'}, {record['seed']}"),
        (
            "device",
            f"{record.get('device')}, {record.get('threads')} thread{'s' * (record.get('threads') != 1)}",
        ),
        *([("Gaussians", f"{data['points']['gaussians']:,}")] if data["points"] else []),
    ]
    if "train_s" in timing:
        facts.append(("training", f"{timing['train_s']:.1f} s, {timing['step_ms']:.1f} ms a step"))
        facts.append(("hull, evaluation", f"{timing['hull_s']:.1f} s, {timing['eval_s']:.1f} s"))
    facts += [(name, value) for name, value in record.get("versions", {}).items() if value]
    orbit = data["orbit"] | {"src": _picture(run, data["orbit"]["file"])}
    return {
        "label": run.label,
        "colour": pen(n)[0],
        "facts": facts,
        "command": data["command"],
        # A line may end between an option and the next, not within one.
        "words": data["command"].split(" "),
        "findings": data["findings"],
        "hull": data["hull"],
        "inputs": [
            row | {"src": _picture(run, row["file"]) if "file" in row else ""} for row in data["inputs"]
        ],
        "orbit": orbit,
        "downloads": _downloads(run.path, folder),
    }


def _same_data(runs: Sequence[Reported]) -> bool:
    """Whether their numbers can be compared."""
    return len({json.dumps(run.record["data"].get("hashes"), sort_keys=True) for run in runs}) == 1


def _metrics(runs: Sequence[Reported]) -> list[dict[str, Any]]:
    """Rows of the table of means: a cell per run with mean, worst view and whether it is the best of several."""
    rows, comparable = [], _same_data(runs)
    for key, title, unit, digits, more in METRICS:
        means = [run.record.get("metrics", {}).get("test", {}).get(key) for run in runs]
        if all(m is None for m in means):
            continue
        best = (max if more else min)(m for m in means if m is not None)
        cells = []
        for run, mean in zip(runs, means, strict=True):
            values = [v[key] for v in run.record["metrics"]["per_view"].values() if v.get(key) is not None]
            worst = (min if more else max)(values) if values else None
            cells.append(
                {
                    "mean": "" if mean is None else f"{mean:.{digits}f}",
                    "worst": "" if worst is None else f"{worst:.{digits}f}",
                    "best": len(runs) > 1 and mean == best and comparable,
                }
            )
        per_view = [
            (name, [_spell(run.record["metrics"]["per_view"].get(name, {}).get(key), digits) for run in runs])
            for name in runs[0].record["metrics"]["per_view"]
        ]
        arrow = "↑" if more else "↓"
        rows.append({"title": f"{title} {arrow}", "unit": unit, "cells": cells, "views": per_view})
    return rows


def _spell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _places(runs: Sequence[Reported]) -> list[dict[str, Any]]:
    """Views with their pictures; those of the same name in several runs stand beside each other."""
    names = list(dict.fromkeys(view["name"] for run in runs for view in run.data["views"]))
    places = []
    for name in names:
        cards = []
        for n, run in enumerate(runs):
            for view in run.data["views"]:
                if view["name"] == name:
                    row = run.record.get("metrics", {}).get("per_view", {}).get(name, {})
                    pictures = {what: _picture(run, file) for what, file in view["files"].items()}
                    said = f"{row['psnr']:.2f} dB" if row.get("psnr") is not None else run.data["kind"]
                    size = {"width": view["width"], "height": view["height"]}
                    cards.append({"label": run.label, "n": n, "said": said, "pictures": pictures, **size})
        places.append({"name": name, "cards": cards})
    return places


def _picture(run: Reported, file: str) -> str:
    data = (run.path / FOLDER / file).read_bytes()
    return "data:image/webp;base64," + base64.b64encode(data).decode()


def _downloads(path: Path, folder: Path) -> list[dict[str, str]]:
    """Files of the run that lie beside the page."""
    files = [f for pattern in _DOWNLOADS for f in sorted((path / "export").glob(pattern))]
    others = ("hull/hull.ply", "hull/inside.ply", "renders/test_sheet.png", "run.json", "log.jsonl")
    files += [path / name for name in others if (path / name).exists()]
    rows = []
    for file in files:
        link = quote(os.path.relpath(file, folder).replace(os.sep, "/"))
        rows.append({"name": str(file.relative_to(path)), "link": link, "size": _size(file.stat().st_size)})
    return rows


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{max(count / 1e3, 0.1):.1f} kB"
