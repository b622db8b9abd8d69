"""visdom-prepare: from a folder of photographs to a scene with cameras and masks."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from visdom_plugin.cli.clashes import NEEDS_OF_PREPARE, refuse_unread
from visdom_plugin.cli.entry import run
from visdom_plugin.cli.output.terminal import load_torch
from visdom_plugin.errors import ConfigError
from visdom_plugin.prepare.settings import BoardSettings, MaskSettings, MaskWay, Volume

if TYPE_CHECKING:
    from visdom_plugin.prepare.run import Prepared


@dataclass(frozen=True)
class Options(BoardSettings):
    """Make a scene of photographs: cameras, masks, pictures without lens distortion.

    visdom-prepare --print-board board.pdf writes the board to print; lay it under the object, take 6 to 50
    photographs with one lens, without zooming, and run visdom-prepare PHOTOS --out SCENE. PHOTOS is never touched.
    """

    photographs: tyro.conf.Positional[Path | None] = None
    """Folder of the photographs."""
    out: Path | None = None
    """Folder to make the scene in; by default PHOTOS_scene."""
    print_board: Path | None = None
    """Write the board as PDF at true size, and nothing else."""
    paper: Literal["a4", "letter", "a3", "tabloid"] = "a4"
    """Paper to print the board on."""
    demo: Path | None = None
    """Write photographs of the built-in object on the board into this folder, to try the command with; and nothing
    else."""
    poses: Path | None = None
    """Poses of another program, in place of a board's: a COLMAP model, transforms.json, Metashape's XML,
    RealityScan's CSV or XMP, Record3D, Polycam, 3D Scanner App, VGGT, pi3, DUSt3R. board: those of the board, even
    where PHOTOS has others."""
    colmap: bool = False
    """Run COLMAP for poses (extra colmap); 10 photographs at least, better 20 to 50, that overlap."""
    focal_35mm: float | None = None
    """Focal length as its 35 mm equivalent, where the files have no EXIF data and the views do not tell it."""
    refine_poses: bool = False
    """Turn the cameras by what makes the masks agree: for poses that are off by up to a few degrees; six views or
    more, and masks that you trust."""
    masks: str | None = None
    """Folder of masks that you have; by default one of a usual name in PHOTOS, or alpha channels."""
    mask_source: MaskWay = "auto"
    """auto: masks that are there, else grabcut. given: only those. grabcut: from colours and the views' hull.
    rembg: its networks. none: no masks."""
    box: Volume | None = None
    """The object lies in this box, in scene units (on a board: metres from its middle, z up)."""
    height: float | None = None
    """The object is not taller than this above the board, in metres; by default the board's long side."""
    rounds: Annotated[int, tyro.conf.arg(name="mask-rounds")] = MaskSettings.rounds
    """Rounds in which the hull of all views corrects each mask."""
    rembg_models: str | None = None
    """Folder that holds rembg's models (.onnx)."""
    rembg_model: str = MaskSettings.model
    """Name of rembg's model."""
    size: int = 1600
    """Longest side of the pictures written, in pixels; 0 for the photographs' own."""
    overwrite: bool = False
    """Make a scene anew that visdom-prepare made before."""
    json: bool = False
    """Print prepare.json in place of the summary."""
    quiet: bool = False
    """Print nothing but errors."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return run(_main, argv)


def _main(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-prepare")
    refuse_unread(argv, NEEDS_OF_PREPARE)
    other = "--print-board" if options.print_board else "--demo" if options.demo else None
    if options.photographs is not None and other is not None:
        raise ConfigError(
            f"{other} makes something of its own, and {options.photographs} would not be read",
            todo=f"leave out {other}, or the folder of photographs",
        )
    board = BoardSettings(**{f.name: getattr(options, f.name) for f in fields(BoardSettings)})
    if options.print_board is not None:
        _print_board(options, board)
        return
    if options.demo is not None:
        _write_demo(options, board)
        return
    if options.photographs is None:
        raise ConfigError(
            "no folder of photographs is named",
            todo="visdom-prepare PHOTOS --out SCENE, or visdom-prepare --print-board board.pdf",
        )
    load_torch()
    from visdom_plugin.prepare.run import Plan, prepare

    out = options.out or Path(f"{options.photographs.resolve().name}_scene")
    masks = MaskSettings(
        options.mask_source,
        options.box,
        options.height,
        options.rounds,
        options.rembg_models,
        options.rembg_model,
    )
    plan = Plan(
        photographs=options.photographs,
        out=out,
        size=options.size,
        masks_folder=options.masks,
        poses=_find_poses(options),
        focal_35mm=options.focal_35mm,
        refine_poses=options.refine_poses,
        overwrite=options.overwrite,
        board=board,
        masks=masks,
    )
    made = prepare(plan)
    if options.json:
        sys.stdout.write(json.dumps(made.record) + "\n")
    elif not options.quiet:
        sys.stdout.write(_summary(made, out))


def _print_board(options: Options, board: BoardSettings) -> None:
    from visdom_plugin.prepare.board import print_board

    assert options.print_board is not None
    print_board(options.print_board, board, options.paper)
    if not options.quiet:
        sys.stdout.write(f"{options.print_board}: print it at 100 %, check the ruler, and lay it flat\n")


def _write_demo(options: Options, board: BoardSettings) -> None:
    load_torch()
    from visdom_plugin.prepare.demo import FILLING, DemoConfig, write_demo

    assert options.demo is not None
    if options.demo.exists() and (not options.demo.is_dir() or any(options.demo.iterdir())):
        raise ConfigError(
            "there is something of this name", where=f"--demo {options.demo}", todo="name a new folder"
        )
    board.check()
    truths = write_demo(options.demo, DemoConfig(focal_35=FILLING), board)
    if not options.quiet:
        sys.stdout.write(
            f"{len(truths)} photographs in {options.demo}; next: visdom-prepare {options.demo}\n"
        )


def _find_poses(options: Options) -> Path | None:
    if options.colmap and options.poses is not None:
        raise ConfigError("poses of two sources: --poses and --colmap", todo="name one")
    return Path("colmap") if options.colmap else options.poses


def _summary(made: Prepared, out: Path) -> str:
    record = made.record
    poses, views, left = record["poses"], record["views"], record["left_out"]
    lines = [
        ("scene", str(out)),
        ("photographs", f"{len(views)} of {len(views) + len(left)}, {poses['source']}"),
    ]
    if "focal_px" in poses:
        lens = f"focal length {poses['focal_px']:.1f} px, k1 {poses['k1']:.4f}, k2 {poses['k2']:.4f}"
        lines.append(("lens", f"{lens}; reprojection error {poses['reprojection_px']:.2f} px"))
    ways = sorted({view["mask"] for view in views.values()})
    lines.append(("masks", ", ".join(f"{sum(v['mask'] == w for v in views.values())} {w}" for w in ways)))
    lines += [("left out", f"{name}: {why}") for name, why in left.items()]
    lines += [("note", note) for note in made.notes]
    if made.made:
        check = f"visdom-check {shlex.quote(str(out))} --views {len(views)}"
        lines.append(("next", f"look at {out / 'prepare.png'}, then: {check}"))
    width = max(len(name) for name, _ in lines)
    return "".join(f"{name:<{width}}  {text}\n" for name, text in lines)


if __name__ == "__main__":
    sys.exit(main())
