"""visdom-check: finds what is wrong with a scene, before a minute is spent on training."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from datamodules.built_in import on_disk
from visdom_plugin.cli.entry import run
from visdom_plugin.cli.options import FolderOptions, read_options, refuse_large_k
from visdom_plugin.cli.output.reports import training_command
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import PAGE, ConfigError, SceneError, count_of, list_some
from visdom_plugin.hull.settings import HullSettings

if TYPE_CHECKING:
    from visdom_plugin.hull.checks.check import Check
    from visdom_plugin.hull.checks.findings import Finding
    from visdom_plugin.scene import Scene, Views

FOUND = 1
"""Exit status with findings."""
FEW_VIEWS = 6
"""How many views to train with where all were looked at: some are left to test on."""

_WIDE = (0.8, 1.25)
"""Focal lengths that could be so much shorter, or longer, are worth a line."""
GEOMETRY = {"axes", "centres", "disagreement", "order", "principal", "scale", "swapped", "turned", "view"}
"""Kinds of findings by which masks and cameras do not fit each other, whatever K is."""


@dataclass(frozen=True)
class Options(FolderOptions):
    """Check cameras, masks and photographs of a scene.

    Finds masks that are inverted, empty, full, cut off, speckled, doubled or of the wrong size; poses with wrong
    axes; photographs in the wrong order; wrong focal lengths; the view that does not fit the others; views from
    too similar directions; and advises K. Exits with 0 when nothing is wrong, 1 with
    findings, 2 when the scene cannot be read.
    """

    k: Annotated[int | Literal["auto"], tyro.conf.arg(aliases=["-k"])] = "auto"
    """K that you will train with; auto has the check advise one."""
    out: Path | None = None
    """Folder for the contact sheet (check.png) and the report (check.json)."""
    json: bool = False
    """Print one JSON object instead of the table."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return run(_main, argv)


def _main(argv: Sequence[str]) -> int:
    options = tyro.cli(Options, args=list(argv), prog="visdom-check")
    folder = options.find_scene_folder()
    place = on_disk(folder)
    if options.k != "auto" and options.k < 1:
        raise ConfigError(f"k is {options.k}", where="--k", todo="use a whole number from 1, or auto")
    if options.out is not None and options.out.exists() and not options.out.is_dir():
        raise ConfigError("this is a file, not a folder", where=f"--out {options.out}", todo="name a folder")
    k = None if options.k == "auto" else options.k
    if k is not None:
        refuse_large_k(options, HullSettings(k=k))
    started = time.perf_counter()
    load_torch()
    from visdom_plugin.cli.scenes import carving_views, open_scene

    try:
        scene = open_scene(folder, **read_options(options), fill=False, test=False)
        views, masks = carving_views(scene.train)
    except SceneError as error:
        if place is None or not _is_about_a_mask(error, place):
            raise
        _show({"scene": place.name, "views": [], "findings": [_unreadable(error)], "notes": []}, options)
        return FOUND
    loaded = time.perf_counter()
    if k is not None:
        HullSettings(k=k).require_views(len(views))
    found = check_views(views, masks, k=k, layout=scene.source.get("layout"))
    found = replace(found, findings=[*doubt_masks(scene, views.names), *found.findings])
    if len(views) < min(2, len(scene.train)):
        count = len(scene.train) - len(views)
        todo = f"make masks for the other {count} views, or name views that have one with --train-list"
        made = [f._replace(todo=todo) if f.kind == "few" else f for f in found.findings]
        found = replace(found, findings=made)
    report = {"scene": scene.name, **describe_check(found, views.names, inverted=options.invert_masks)}
    if place is not None and found.usable:
        report["choice"] = _suggest(scene, found, views.names, place, read_options(options))
    report["seconds"] = {
        "load": round(loaded - started, 3),
        "check": round(time.perf_counter() - loaded, 3),
    }
    if options.out is not None:
        from visdom_plugin.atomic_files import write_bytes
        from visdom_plugin.figures.check_sheet import draw_check
        from visdom_plugin.figures.contact_sheet import write_png

        options.out.mkdir(parents=True, exist_ok=True)
        write_png(options.out / "check.png", draw_check(views, masks, found))
        report["out"] = str(options.out)
        write_bytes(options.out / "check.json", (json.dumps(report, indent=1) + "\n").encode())
    _show(report, options)
    if not (found.findings or options.json or options.quiet):
        cameras = scene.train.cameras
        longest = int(max(cameras.width.max(), cameras.height.max()))
        from visdom_plugin.hull.checks.covisibility import USUAL_K

        wanted = found.advice.k if found.advice is not None and k is None else k
        k = None if wanted == USUAL_K else wanted
        reading = read_options(options)
        if scene.all_train:
            reading["views"] = min(reading["views"], FEW_VIEWS)
        say(f"next: {training_command(folder, reading, longest, k=k)}")
    return FOUND if found.findings else 0


def _suggest(
    scene: Scene, found: Check, names: Sequence[str], folder: Path, reading: dict[str, Any]
) -> dict[str, Any] | None:
    """How good the choice of views is, and a better one; None where somebody chose."""
    from visdom_plugin.cli.evaluation.suggest_views import suggest_views, unfit_views

    level = logging.getLogger("datamodules")
    before = level.level
    level.setLevel(logging.ERROR)  # it was all said when the scene was read
    try:
        made = suggest_views(scene, unfit_views([*found.findings, *found.notes], names), folder, **reading)
    except SceneError:  # of views that nobody asked for
        return None
    finally:
        level.setLevel(before)
    return None if made is None else {**made._asdict(), "said": made.describe()}


def warn_of_faults(scene: Scene, *, inverted: bool = False) -> None:
    """A brief check before training: every finding as one warning on the log.

    Args:
        inverted: whether the masks were turned over as they were read.

    Raises:
        SceneError: masks are certainly inverted; what would be trained is the background.
    """
    from visdom_plugin.cli.scenes import carving_views

    log = logging.getLogger(__name__)
    if not scene.train.has_masks:
        return
    views, masks = carving_views(scene.train)
    for f in check_views(views, masks, brief=True, layout=scene.source.get("layout")).findings:
        todo = _advise(f, len(views), inverted)
        if f.kind == "inverted" and f.sure == "certain":
            raise SceneError(
                f.what, where=scene.name, cause="masks that are black on the object", todo=todo, topic=f.kind
            )
        log.warning("%s (%s); what to do: %s; `visdom-check` tells more", f.what, f.sure, todo)


def _advise(finding: Finding, views: int, inverted: bool) -> str:
    """What to do about a finding, with the option that does it where there is one."""
    if finding.kind != "inverted" or len(finding.views) < views:
        return finding.todo
    return "leave out --invert-masks" if inverted else f"{finding.todo}; or pass --invert-masks"


def find_briefly(scene: Scene) -> list[dict[str, Any]]:
    """What the brief check finds, as `describe_check` spells it."""
    from visdom_plugin.cli.scenes import carving_views

    views, masks = carving_views(scene.train)
    found = check_views(views, masks, brief=True, layout=scene.source.get("layout"))
    found = replace(found, findings=[*doubt_masks(scene, views.names), *found.findings])
    return describe_check(found, views.names)["findings"]


def doubt_masks(scene: Scene, names: Sequence[str]) -> list[Finding]:
    """The finding on masks that may be none, as the reader of the scene told; an empty list where there are none.

    Args:
        names: of the views that are checked.
    """
    from visdom_plugin.hull.checks.findings import Finding, Name, spell_range

    views = tuple(i for i, name in enumerate(names) if name in scene.grey_masks)
    if not views:
        return []
    shares = [scene.grey_masks[names[i]] for i in views]
    whose = Name(names).masks_of(views, "is doubtful", "are doubtful")
    share = spell_range(shares, ".0%")
    what = f"{whose}: {share} of the pixels are neither black nor white; they are cut at one half"
    todo = "look at the files: masks are white on the object and black around it, grey on its outline alone"
    return [Finding("mask-grey", what, views, "likely", max(shares), todo)]


@phase("checking cameras and masks")
def check_views(
    views: Views, masks: Sequence, *, k: int | None = None, brief: bool = False, layout: str | None = None
) -> Check:
    """`hull.check.check` of a scene's views; `layout` is that of a scene on disk."""
    from visdom_plugin.hull.checks.causes.pose_conventions import pose_faults
    from visdom_plugin.hull.checks.check import check

    images = () if brief else views.images
    poses = pose_faults(layout)
    return check(
        views.cameras, masks, images, views.names, ignore=views.ignore, k=k, brief=brief, poses=poses
    )


def describe_check(found: Check, names: Sequence[str], *, inverted: bool = False) -> dict[str, Any]:
    """What a check of views with these names found, as plain numbers, strings and lists."""
    usable = [names[i] for i in found.usable]
    report: dict[str, Any] = {
        "views": list(names),
        "clean": not found.findings,
        "findings": [_plain(f, names, inverted) for f in found.findings],
        "notes": [_plain(f, names, inverted) for f in found.notes],
    }
    if found.advice is not None:
        report["k"] = found.advice.k
        report["k_why"] = found.advice.why
        report["covisibility"] = {
            k: {n: round(float(c), 4) for n, c in zip(usable, shares, strict=True)}
            for k, shares in found.advice.covered.items()
        }
    if found.focal_range is not None:
        report["focal_range"] = list(found.focal_range)
    if found.fit is not None:
        from visdom_plugin.hull.outlines.distance_fields import OBJECT_PX

        report["misfit"] = round(found.fit.score / OBJECT_PX, 6)
        report["constraint"] = round(found.fit.power / OBJECT_PX, 6)
    return report


def _plain(finding: Finding, names: Sequence[str], inverted: bool) -> dict[str, Any]:
    turned = {} if finding.turned_deg is None else {"turned_deg": finding.turned_deg}
    return {
        "kind": finding.kind,
        "what": finding.what,
        "views": [names[i] for i in finding.views],
        "sure": finding.sure,
        "evidence": round(float(finding.evidence), 6),
        "todo": _advise(finding, len(names), inverted),
        **turned,
    }


def _is_about_a_mask(error: SceneError, folder: Path) -> bool:
    """Whether one mask of a scene that is otherwise there made it unreadable."""
    where = error.where
    if not isinstance(where, Path) or not where.is_file():
        return False
    return "mask" in error.what and where.resolve().is_relative_to(folder.resolve())


def _unreadable(error: SceneError) -> dict[str, Any]:
    kind = error.topic if error.topic in ("empty", "size", "mask-grey") else "mask"
    what = error.what + (f" ({error.cause})" if error.cause else "")
    return {
        "kind": kind,
        "what": what,
        "views": [Path(str(error.where)).stem],
        "sure": "certain",
        "evidence": 1.0,
        "todo": error.todo or "",
    }


def _show(report: dict[str, Any], options: Options) -> None:
    if options.json:
        sys.stdout.write(json.dumps(report) + "\n")
    elif not options.quiet:
        _table(report)


def _table(report: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    colours = {"certain": "red", "likely": "yellow", "possible": "cyan", "note": "dim"}
    rows = [*((f["sure"], f) for f in report["findings"]), *(("note", f) for f in report["notes"])]
    count = len(report["findings"])
    said = count_of(count, "finding") if count else "nothing wrong"
    choice = report.get("choice")
    views = count_of(choice["free"] if choice else len(report["views"]), "view")
    if choice:
        views = f"{len(report['views'])} of {views}"
    elif not report["views"]:
        views = "cannot be read"
    console.print(f"[bold]{escape(report['scene'])}[/bold]: {views}, {said}")
    if rows:
        table = Table(show_edge=False, pad_edge=False, show_lines=True)
        for title in ("", "sure", "views", "what, and what to do"):
            table.add_column(title)
        for sure, f in rows:
            text = f"{escape(f['what'])}\n[italic]{escape(f['todo'])}[/italic]"
            table.add_row(
                f["kind"], f"[{colours[sure]}]{sure}[/]", escape(list_some(f["views"], 3)) or "all", text
            )
        console.print(table)
        console.print(f"more on each: {PAGE}#findings", soft_wrap=True)
    for line in summarise_fit(report):
        console.print(escape(line), soft_wrap=True)  # options can be copied whole
    if "out" in report:
        console.print(f"sheet: {escape(report['out'])}/check.png")


def summarise_fit(report: dict[str, Any]) -> list[str]:
    """Lines on K, and on how well masks and cameras fit, as far as `describe_check` knows them."""
    lines = [report["k_why"]] if "k_why" in report else []
    if lines and not GEOMETRY.isdisjoint(f["kind"] for f in report["findings"]):
        lines = ["Which K the views allow is told once poses and intrinsics fit the masks."]
    low, high = report.get("focal_range", (1.0, 1.0))
    if low <= _WIDE[0] or high >= _WIDE[1]:
        lines.append(
            f"Focal lengths {low:g} to {high:g} times as long would fit the masks about as well, with a larger or "
            "a smaller hull: masks do not tell whether they are right."
        )
    if report.get("choice"):
        lines.append(report["choice"]["said"])
    if "misfit" not in report:
        return lines
    from visdom_plugin.hull.checks.check import SPEAKING_PX
    from visdom_plugin.hull.outlines.distance_fields import OBJECT_PX

    if report["constraint"] < SPEAKING_PX / OBJECT_PX:
        return [
            *lines,
            "The masks rule out nothing for one another, so they do not tell whether cameras fit.",
        ]
    missed = f"asks and cameras miss each other by {report['misfit']:.2%} of the object's size on average"
    lines.append(
        f"Apart from what was found, m{missed}." if report["findings"] else f"M{missed}; 0 is a perfect fit."
    )
    lines.append(
        f"Sensitivity to wrong poses: {report['constraint']:.1%} of the object's size, by which the other masks "
        "exclude it right beside each mask; the higher, the smaller an error that shows."
    )
    return lines


if __name__ == "__main__":
    sys.exit(main())
