"""visdom-hull: carves the visible domain of a scene, measures it and writes it down."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from visdom_plugin.cli.clashes import NEEDS_OF_HULL, refuse_unread
from visdom_plugin.cli.commands.check import check_views, describe_check, summarise_fit
from visdom_plugin.cli.entry import run
from visdom_plugin.cli.options import FolderOptions, read_options, refuse_large_k
from visdom_plugin.cli.output.terminal import load_torch
from visdom_plugin.compute import ahead
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import ConfigError, count_of
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.hull.settings import HullSettings

if TYPE_CHECKING:
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Scene

ENDINGS = (".ply", ".obj", ".glb", ".npz")
"""Of files that --out may name: meshes, and last the voxel grid."""
_UNCOVERED = 0.9
"""Share of a mask below which the hull leaves it uncovered."""


@dataclass(frozen=True)
class Options(FolderOptions, HullSettings):
    """Carve the visible-domain hull of a scene from its cameras and masks.

    Prints what it measured; --out writes the mesh (.ply, .obj, .glb) or the voxel grid (.npz).
    """

    k: Annotated[int | Literal["n-1", "auto"], tyro.conf.arg(aliases=["-k"])] = HullSettings.k
    """K, the fewest views that must see a voxel. n-1: all but one. auto: 3, or 2 where 3 loses more of a mask."""
    inside: bool = False
    """Report and write, in place of the hull, the smoothest shape inside it that covers the masks as well."""
    inside_radius: float | None = None
    """With --inside: what no silhouette holds is rounded to this radius, in hull radii; by default 2, as in
    visdom-gs. visdom-field takes 1."""
    photo_weight: float | None = None
    """With --inside: how much the photographs have a say, 0 to 0.5; by default 0. visdom-gs takes 0.15."""
    out: Path | None = None
    """File to write: .ply, .obj or .glb for the mesh, .npz for the grid."""
    masks_out: Path | None = None
    """Folder to write masks to: the hull's outline seen by each of --cameras, 8-bit PNG, white on the hull."""
    cameras: Literal["train", "test", "orbit"] = "test"
    """Cameras of --masks-out: the scene's, or a circle round the hull (with a transforms.json)."""
    frames: int = 60
    """Cameras on the circle."""
    overwrite: bool = False
    """Let --masks-out overwrite files."""
    json: bool = False
    """Print one JSON object instead of the table."""
    diagnose: bool = False
    """Report what visdom-check finds, and masks that the hull leaves uncovered."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return run(_main, argv)


def _main(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-hull")
    refuse_unread(argv, NEEDS_OF_HULL)
    folder = options.find_scene_folder()
    if options.out is not None and options.out.suffix.lower() not in ENDINGS:
        raise ConfigError(
            f"cannot write {options.out.name}",
            where="--out",
            todo=f"end the name in {', '.join(ENDINGS[:-1])} (mesh) or {ENDINGS[-1]} (voxel grid)",
        )
    names = [f.name for f in fields(VisibleDomain)]
    domain = VisibleDomain(**{name: getattr(options, name) for name in names})
    inside = _inside_config(options)
    refuse_large_k(options, domain)
    if options.frames < 1:
        raise ConfigError(f"--frames is {options.frames}; it must be at least 1")
    ahead.prepare("hull")
    load_torch()
    from visdom_plugin.cli.scenes import open_scene

    masks = None
    if options.masks_out is not None:
        masks = MaskRequest(options.masks_out, options.cameras, options.frames, options.overwrite)
    scene = open_scene(
        folder,
        **read_options(options),
        fill=False,
        test=masks is not None and masks.cameras == "test",
    )
    if views := len(scene.train.with_masks()):
        domain.require_views(views)
    report = report_hull(
        domain, scene, out=options.out, diagnosing=options.diagnose, masks=masks, inside=inside
    )
    if options.json:
        sys.stdout.write(json.dumps(report) + "\n")
    elif not options.quiet:
        sys.stdout.write(_table(report))


def _inside_config(options: Options) -> InsideConfig | None:
    """What is asked of the shape inside; None where it is not."""
    if not options.inside:
        return None
    radius, weight, default = options.inside_radius, options.photo_weight, InsideConfig()
    try:
        return InsideConfig(
            radius=default.radius if radius is None else radius,
            photo_weight=default.photo_weight if weight is None else weight,
        )
    except ConfigError as error:
        option = "--photo-weight" if error.what.startswith("photo_weight") else "--inside-radius"
        raise ConfigError(error.what, where=option, todo=error.todo) from error


@dataclass(frozen=True)
class MaskRequest:
    """Masks to make of a hull."""

    folder: Path
    cameras: str
    frames: int
    overwrite: bool


@phase("carving and measuring the hull")
def report_hull(
    domain: VisibleDomain,
    scene: Scene,
    *,
    out: Path | None = None,
    diagnosing: bool = False,
    masks: MaskRequest | None = None,
    inside: InsideConfig | None = None,
) -> dict[str, Any]:
    """Carves, measures and writes one hull, or, with `inside`, the shape inside it, and its masks.

    Returns:
        Plain numbers and lists, ready for JSON.
    """
    from visdom_plugin.hull.checks.coverage import measure_coverage
    from visdom_plugin.hull.checks.mask_checks import border_share
    from visdom_plugin.hull.grid.mesh import is_closed
    from visdom_plugin.scene import describe_masks

    views = scene.train
    cameras, silhouettes, ignore = views.silhouettes()
    given = [i for i in range(len(views)) if views.mask_origin(i) == "given"]
    names, known = [views.names[i] for i in given], [views.demanded(i) for i in given]
    hull = outer = domain.carve(cameras, silhouettes, ignore)
    if inside is not None:
        from visdom_plugin.hull.inside.shape import shape_inside

        photographs = [views.images[i] for i in views.with_masks()]
        hull = shape_inside(outer, cameras, silhouettes, ignore, inside, photographs)
    coverage = measure_coverage(hull, cameras, silhouettes, ignore)
    summary = hull.summary
    report = {
        "scene": scene.name,
        "views": names,
        "masks": [*describe_masks(views), *scene.notes],
        "kind": summary["kind"],
        "k": summary["k"],
        "voxels": hull.voxels,
        "volume": hull.volume,
        "surface_area": hull.surface_area,
        "bounds": hull.bounds.tolist(),
        "extent": hull.extent.tolist(),
        "resolution": max(hull.shape),
        "shape": list(hull.shape),
        "voxel_size": hull.voxel_size,
        "seconds": summary["seconds"],
        "bounds_seconds": summary["bounds_seconds"],
        "bounds_closed": summary["bounds_closed"],
        "coverage": {n: round(c.covered, 6) for n, c in zip(names, coverage, strict=True)},
        "inside_mask": {n: round(c.inside, 6) for n, c in zip(names, coverage, strict=True)},
        "touches_border": [n for n, m in zip(names, known, strict=True) if border_share(m.numpy()) > 0],
        "components": summary["components"],
        "components_found": summary["components_found"],
        "components_dropped": summary["components_dropped"],
        "watertight": is_closed(hull.to_mesh()[1]),
        "agreement_means": summary["agreement_means"],
    }
    if inside is not None:
        report |= {
            "hull_volume": outer.volume,
            "hull_seconds": outer.summary["seconds"],
            "radius": summary["radius"],
            "photo_weight": inside.photo_weight,
        }
    if diagnosing:
        report["diagnosis"] = _diagnose(scene, report)
    if out is not None:
        _write(out, hull)
        report["out"] = str(out)
    if masks is not None:
        from visdom_plugin.cli.hulls.hull_masks import mask_cameras, write_masks

        seen_by, files = mask_cameras(masks.cameras, scene, hull, masks.frames)
        orbit = masks.cameras == "orbit"
        write_masks(hull, seen_by, files, masks.folder, poses=orbit, overwrite=masks.overwrite)
        report["masks_out"] = {"folder": str(masks.folder), "cameras": masks.cameras, "count": len(files)}
    return report


def _write(path: Path, hull: Hull) -> None:
    """The voxel grid as .npz, the mesh by any other ending."""
    from visdom_plugin.export.meshes import Mesh, write_mesh

    if path.suffix.lower() == ENDINGS[-1]:
        hull.save(path)
    else:
        write_mesh(path, Mesh(*hull.to_mesh()))


def _diagnose(scene: Scene, report: dict[str, Any]) -> dict[str, Any]:
    """What the check finds, and where the hull falls short of the masks."""
    from visdom_plugin.cli.scenes import carving_views

    views, masks = carving_views(scene.train)
    k = report["k"] or None if report["kind"] in ("visdom", "inside") else None
    found = describe_check(check_views(views, masks, k=k, layout=scene.source.get("layout")), views.names)
    for name, share in report["coverage"].items():
        if share < _UNCOVERED:
            what = f"the hull covers only {share:.1%} of the mask of {name}"
            todo = "look at this view's pose, and at the other masks; they rule the rest out, or K does"
            found["findings"].append(_finding("uncovered", what, [name], share, todo))
    if not report["bounds_closed"]:
        what, todo = "the views leave the hull open; it is cut off at its box", "use a larger K, or --bounds"
        found["findings"].append(_finding("open", what, [], 1.0, todo))
    return found | {"clean": not found["findings"]}


def _finding(kind: str, what: str, views: list[str], evidence: float, todo: str) -> dict[str, Any]:
    return {"kind": kind, "what": what, "views": views, "sure": "certain", "evidence": evidence, "todo": todo}


def _inside_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    if "hull_volume" not in report:
        return []
    share = report["volume"] / report["hull_volume"]
    text = f"{share:.1%} of the hull's volume, rounded to {report['radius']:g} of its radius"
    if report["photo_weight"]:
        text += f", photographs have a say of {report['photo_weight']:g}"
    return [("inside", text)]


def _table(report: dict[str, Any]) -> str:
    from visdom_plugin.hull.carving.carve import describe_pieces
    from visdom_plugin.hull.carving.keep_rule import describe_rule

    size = " x ".join(f"{b - a:.4g}" for a, b in zip(*report["extent"], strict=True))
    rows = [
        ("scene", f"{report['scene']}, {count_of(len(report['views']), 'view')}"),
        ("rule", f"{report['kind']}: {describe_rule(report)}"),
        *(("data", text) for text in report["masks"]),
        (
            "voxels",
            f"{report['voxels']} of {' x '.join(map(str, report['shape']))}, edge {report['voxel_size']:.4g}",
        ),
        *_inside_rows(report),
        ("size", f"{size}, volume {report['volume']:.5g}, surface {report['surface_area']:.5g}"),
        ("pieces", describe_pieces(report)),
        ("mesh", "watertight" if report["watertight"] else "not watertight"),
        ("seconds", f"{report['seconds']:.2f}, and {report['bounds_seconds']:.2f} to find the bounds"),
    ]
    rows += [
        (name, f"{share:.1%} of the mask covered, {report['inside_mask'][name]:.1%} of the hull on it")
        for name, share in report["coverage"].items()
    ]
    if "diagnosis" in report:
        found = report["diagnosis"]
        rows += [("check", line) for line in summarise_fit(found)]
        rows += [("found", f"{f['what']}; {f['todo']}") for f in found["findings"]] or [
            ("found", "nothing wrong")
        ]
        rows += [("note", f"{f['what']}; {f['todo']}") for f in found["notes"]]
    if "out" in report:
        rows.append(("written", report["out"]))
    if "masks_out" in report:
        made = report["masks_out"]
        rows.append(("masks", f"{made['count']} of the {made['cameras']} cameras in {made['folder']}"))
    width = max(len(name) for name, _ in rows)
    return "".join(f"{name:<{width}}  {text}\n" for name, text in rows)
