"""visdom-hull: carve the visible domain of a scene, measure it and write it down."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from visdom_plugin.cli.errors import run
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import Box, VisibleDomain

_DEFAULT = VisibleDomain()


@dataclass(frozen=True)
class Options:
    """Carve the visible-domain hull of a scene from its cameras and masks.

    Prints what it measured; --out writes the mesh (.ply) or the voxel grid (.npz).
    """

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of the scene; without it, the built-in scene."""
    data: Path | None = None
    """The same as the positional argument."""
    views: int = 4
    """Training views; the hull sees no others."""
    downscale: float = 1.0
    """Work on images smaller by this factor."""
    seed: int = 0
    """Of the built-in scene."""
    k: Annotated[int | Literal["n-1", "auto"], tyro.conf.arg(aliases=["-k"])] = _DEFAULT.k
    """Fewest views that must see a voxel."""
    agreement: float = _DEFAULT.agreement
    """Share of the views that see a voxel that must have it inside their mask."""
    max_misses: int | None = None
    """Views that may miss, in place of the agreement."""
    kind: Literal["visdom", "traditional", "unit-sphere", "released-go"] = "visdom"
    """Which hull: the visible domain, without K, that inside a ball, or GaussianObject's rule."""
    resolution: int = _DEFAULT.resolution
    """Voxels along the grid's longest side."""
    bounds: Box | None = None
    """Lower and upper corner, six numbers in world units; by default found from cameras and masks."""
    components: Literal["drop-small", "all", "largest"] = "drop-small"
    """Which connected pieces stay."""
    min_component_fraction: float = _DEFAULT.min_component_fraction
    """Pieces below this fraction of the largest are small."""
    dilate_px: int = 0
    """Grow the masks by this many pixels first."""
    sphere_centre: tuple[float, float, float] | None = None
    """Centre of the ball of --kind unit-sphere, world units."""
    sphere_radius: float | None = None
    """Radius of that ball."""
    out: Path | None = None
    """File to write: .ply for the mesh, .npz for the grid."""
    json: bool = False
    """Print one JSON object instead of the table."""
    diagnose: bool = False
    """Look for what is wrong: the view that disagrees, masks that touch the border, what each K leaves."""
    quiet: bool = False
    """Print nothing but errors."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return run(_main, argv)


def _main(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-hull")
    if options.folder is not None and options.data is not None and options.folder != options.data:
        raise ConfigError(f"two scenes: {options.folder} and {options.data}", todo="name one")
    if options.out is not None and options.out.suffix not in (".ply", ".npz"):
        raise ConfigError(
            f"cannot write {options.out.name}",
            where="--out",
            todo="name a .ply (mesh) or .npz (voxel grid) file",
        )
    names = [f.name for f in fields(VisibleDomain)]
    domain = VisibleDomain(**{name: getattr(options, name) for name in names})
    import datamodules

    scene = datamodules.load(
        options.folder or options.data, views=options.views, downscale=options.downscale, seed=options.seed
    )
    report = report_hull(domain, scene, out=options.out, diagnosing=options.diagnose)
    if options.json:
        sys.stdout.write(json.dumps(report) + "\n")
    elif not options.quiet:
        sys.stdout.write(_table(report))


def report_hull(
    domain: VisibleDomain, scene, *, out: Path | None = None, diagnosing: bool = False
) -> dict[str, Any]:
    """Carves, measures and writes one hull.

    Returns:
        Plain numbers and lists, ready for JSON.
    """
    from visdom_plugin.hull.diagnose import border_share, diagnose, measure_coverage
    from visdom_plugin.hull.mesh import is_closed

    views = scene.train
    hull = domain.carve(views.cameras, views.masks)
    coverage = measure_coverage(hull, views.cameras, views.masks)
    summary = hull.summary
    report = {
        "scene": scene.name,
        "views": list(views.names),
        "kind": domain.kind,
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
        "coverage": {n: round(c.covered, 6) for n, c in zip(views.names, coverage, strict=True)},
        "inside_mask": {n: round(c.inside, 6) for n, c in zip(views.names, coverage, strict=True)},
        "touches_border": [
            n for n, m in zip(views.names, views.masks, strict=True) if border_share(m.numpy()) > 0
        ],
        "components": summary["components"],
        "components_found": summary["components_found"],
        "watertight": is_closed(hull.to_mesh()[1]),
        "agreement_means": summary["agreement_means"],
    }
    if diagnosing:
        found = diagnose(domain, hull, views.cameras, views.masks, views.names)
        report["diagnosis"] = {
            "findings": found.findings,
            "removes": {n: round(v.removes, 4) for n, v in zip(views.names, found.views, strict=True)},
            "voxels_per_k": found.voxels_per_k,
        }
    if out is not None:
        hull.write_ply(out) if out.suffix == ".ply" else hull.save(out)
        report["out"] = str(out)
    return report


def _table(report: dict[str, Any]) -> str:
    size = " x ".join(f"{b - a:.4g}" for a, b in zip(*report["extent"], strict=True))
    rows = [
        ("scene", f"{report['scene']}, {len(report['views'])} views"),
        ("rule", f"{report['kind']}, K = {report['k']}; {report['agreement_means']}"),
        (
            "voxels",
            f"{report['voxels']} of {' x '.join(map(str, report['shape']))}, edge {report['voxel_size']:.4g}",
        ),
        ("size", f"{size}, volume {report['volume']:.5g}, surface {report['surface_area']:.5g}"),
        ("pieces", f"{report['components']} of {report['components_found']} kept"),
        ("mesh", "watertight" if report["watertight"] else "not watertight"),
        ("seconds", f"{report['seconds']:.2f}, and {report['bounds_seconds']:.2f} to find the bounds"),
    ]
    rows += [
        (name, f"{share:.1%} of the mask covered, {report['inside_mask'][name]:.1%} of the hull on it")
        for name, share in report["coverage"].items()
    ]
    if "diagnosis" in report:
        rows += [
            (
                "K",
                ", ".join(f"{k}: {n}" for k, n in report["diagnosis"]["voxels_per_k"].items())
                + " voxels of 64^3",
            )
        ]
        rows += [
            (name, f"its mask alone removes {x:.1%}") for name, x in report["diagnosis"]["removes"].items()
        ]
        rows += [("found", text) for text in report["diagnosis"]["findings"] or ["nothing wrong"]]
    if "out" in report:
        rows.append(("written", report["out"]))
    width = max(len(name) for name, _ in rows)
    return "".join(f"{name:<{width}}  {text}\n" for name, text in rows)
