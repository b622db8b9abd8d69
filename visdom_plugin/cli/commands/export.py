"""visdom-export: a run, or any file of Gaussians, in the formats that other programs open."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from datamodules.built_in import PREFIX
from visdom_plugin.cli import entry
from visdom_plugin.cli.options import Device, SceneOptions, read_options
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.cli.subject import PointCloud, Subject, is_run, is_splat_file, open_subject, refuse_missing
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from visdom_plugin.export.meshes import Mesh
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.splat.gaussians import Gaussians

SPLATS, MESHES = ("ply", "spz", "splat", "sog", "html"), ("glb", "obj", "ply")
_UP = {"glb": "y", "obj": "y", "ply": "z"}
"""Which axis programs that open meshes of a format take for up; those that open Gaussians take -y."""


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Exports a run, or any file of Gaussians, to the formats that other programs open.

    ply, spz, splat, sog: Gaussians. html: one page that shows them, without a server. glb, obj, and ply with
    --mesh: a mesh with vertex colours, of any method. dataset: pictures without background, masks, and the
    cameras as transforms.json and COLMAP model, with the hull, for LichtFeld, Brush, nerfstudio, 3DGS; a folder
    with a scene will do. Without --format, what the method itself exports, again.

    Everything is in the capture's own frame, unless --upright is given.
    """

    run: tyro.conf.Positional[Path]
    """Run directory, a file of Gaussians (.ply, .spz, .splat, .sog), or, for a dataset, the folder of a scene."""
    format: Literal["ply", "spz", "splat", "sog", "html", "glb", "obj", "dataset"] = "ply"
    """What to write."""
    out: Path | None = None
    """File or folder to write; by default in <run>/export/, and for NAME.ply beside it."""
    mesh: bool = False
    """Write a mesh into the .ply, not Gaussians."""
    crop: Literal["none", "hull"] = "none"
    """Remove what lies more than a voxel outside the hull."""
    upright: bool = False
    """Centre the object at the origin and turn it upright, by the axis convention of the format."""
    info: bool = False
    """Print what a file of Gaussians holds, and write nothing."""
    surface: Literal["depth", "density"] = "depth"
    """Where a mesh comes from: depth as rendered from all round, fused inside the hull; or a radiance field's own
    density."""
    resolution: int = 160
    """Voxels along a mesh's longest side."""
    pieces: float = 0.005
    """Leave out pieces of a mesh that are smaller than this share of the largest one."""
    smooth: int = 2
    """Rounds of smoothing a mesh; 0 for none."""
    device: Device = "auto"
    """Where to compute."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_export, argv)


def _export(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=argv, prog="visdom-export")
    _check(options)
    if options.info:
        _show(options)
        return
    target = _target(options)
    load_torch()
    with phase("exporting"):
        if options.format == "dataset":
            written = _write_dataset(options, target)
        elif options.mesh or options.format in ("glb", "obj") or not _has_gaussians(options):
            written = _write_mesh(options, target)
        else:
            written = _write_splats(options, target)
    if not options.quiet:
        sys.stdout.write("".join(f"{path}\n" for path in written))


def _check(options: Options) -> None:
    """Refuses what cannot go together, before anything is read."""
    refuse_missing(options.run)
    if options.mesh and options.format not in MESHES:
        raise ConfigError(f"--mesh is for {', '.join(MESHES)}", where=f"--format {options.format}")
    if not 8 <= options.resolution <= 1024:
        raise ConfigError(f"--resolution is {options.resolution}", todo="choose 8 to 1024")
    if options.smooth < 0 or not 0 <= options.pieces <= 1:
        raise ConfigError("--smooth must be 0 or more, --pieces from 0 to 1")
    mesh = options.mesh or options.format in ("glb", "obj")
    asks = options.crop != "none" or options.upright or mesh or options.format == "dataset"
    if is_splat_file(options.run) and asks and options.data is None and not options.info:
        raise ConfigError(
            "a file of Gaussians has no cameras and no hull; this needs those of its scene",
            where=options.run,
            todo="--data DIR",
        )


def _show(options: Options) -> None:
    from visdom_plugin.export.splat_files import describe

    if is_splat_file(options.run):
        files = [options.run]
    else:
        files = [f for f in sorted((options.run / "export").glob("*")) if is_splat_file(f) and _is_splats(f)]
    if not files:
        raise ConfigError(
            "there is no file of Gaussians",
            where=options.run / "export",
            cause="the run is of a radiance field, or has not finished",
        )
    for file in files:
        sys.stdout.write(json.dumps(describe(file), indent=1) + "\n")


def _target(options: Options) -> Path:
    suffix = "" if options.format == "dataset" else f".{options.format}"
    if options.out is not None:
        if options.out.suffix.lower() != suffix and suffix:
            raise ConfigError(
                f"the name of this format ends in {suffix}",
                where=f"--out {options.out}",
                todo=f"--out NAME{suffix}, or another --format",
            )
        return options.out
    changed = ("_cropped" if options.crop == "hull" else "") + ("_upright" if options.upright else "")
    if is_splat_file(options.run):
        name = options.run.with_name(f"{options.run.stem}{changed}{suffix or '_dataset'}")
        if name == options.run:
            raise ConfigError("this would replace the file itself", where=name, todo="--out NAME")
        return name
    if not is_run(options.run):
        return Path(f"{options.run.resolve().name.removeprefix(PREFIX)}_dataset")
    mesh = options.mesh or options.format in ("glb", "obj") or not _has_gaussians(options)
    stem = "dataset" if options.format == "dataset" else "mesh" if mesh else "point_cloud"
    # The run itself may have written mesh.ply and point_cloud.ply.
    fused = "_fused" if mesh and options.format == "ply" else ""
    return options.run / "export" / f"{stem}{fused}{changed}{suffix}"


def _is_splats(path: Path) -> bool:
    return path.suffix.lower() != ".ply" or b"f_dc_0" in path.read_bytes()[: 1 << 16]


def _has_gaussians(options: Options) -> bool:
    """Whether the subject is Gaussians, by what is on disk.

    Raises:
        ConfigError: it is not, and the format asks for them.
        CheckpointError: it is no run.
    """
    if is_splat_file(options.run):
        return True
    from visdom_plugin.training.runs.run_directory import read_record

    read_record(options.run)
    ours = options.run / "export" / "point_cloud.ply"
    field = (options.run / "export" / "mesh.ply").exists() and not ours.exists()
    if field and options.format in SPLATS and options.format != "ply":
        raise ConfigError(
            f"this run is of a radiance field, which has no Gaussians to write as {options.format}",
            where=options.run,
            todo="--format glb, obj or ply for its mesh",
        )
    return not field


def _write_dataset(options: Options, target: Path) -> list[Path]:
    import torch

    from visdom_plugin.export.dataset import write_dataset
    from visdom_plugin.export.upright import upright

    if target.is_dir() and any(target.iterdir()):
        raise ConfigError("the folder is not empty", where=target, todo="name a new one with --out")
    if is_run(options.run):
        subject = open_subject(options.run, options, options.device, test=True)
        scene, hull = subject.scene, subject.hull
    else:
        from visdom_plugin.cli.scenes import open_scene

        folder = options.data if is_splat_file(options.run) else options.run
        scene, hull = open_scene(folder, **read_options(options)), None
    hull = hull or _carve(scene.train)
    middle = torch.as_tensor(hull.centre) if hull is not None else None
    motion = upright(scene.train.cameras, middle, "-y") if options.upright and middle is not None else None
    return write_dataset(target, scene, hull, motion)


def _write_splats(options: Options, target: Path) -> list[Path]:
    import torch

    from visdom_plugin.export import splats
    from visdom_plugin.export.splat_files import write_splats
    from visdom_plugin.export.upright import upright

    origin: Tensor | None = None
    eye: Tensor | None = None
    title = None
    if options.crop == "none" and not options.upright and not is_run(options.run):
        gaussians, origin = _read_plain(options.run)
    else:
        subject = open_subject(options.run, options, options.device, test=False)
        gaussians, origin = _gaussians_of(options, subject)
        title, eye = subject.scene.name, subject.scene.train.cameras.centres[0].double() - origin
        if options.crop == "hull":
            hull, at = _need_hull(subject), origin
            before = len(gaussians)
            gaussians = splats.crop(gaussians, lambda x: hull.contains(x.double() + at, margin_voxels=1))
            _say(options, f"{before - len(gaussians)} of {before} Gaussians lie outside the hull")
        if options.upright:
            motion = upright(subject.scene.train.cameras, torch.as_tensor(_need_hull(subject).centre), "-y")
            motion[:3, 3] += motion[:3, :3] @ origin
            eye = motion[:3, :3] @ eye + motion[:3, 3]
            gaussians, origin = splats.move(gaussians, motion), None
    write_splats(target, gaussians, origin, title=title, eye=eye)
    return [target]


def _read_plain(path: Path) -> tuple[Gaussians, Tensor]:
    from visdom_plugin.export.splat_files import read_near

    return read_near(path)


def _gaussians_of(options: Options, subject: Subject) -> tuple[Gaussians, Tensor]:
    """Gaussians relative to an origin near them, float32 on the CPU, and that origin (3,) float64."""
    import tempfile

    from visdom_plugin.geometry.local_frame import local_origin
    from visdom_plugin.splat.ply import read_ply

    if isinstance(subject.renderer, PointCloud):
        return subject.renderer.gaussians.to("cpu"), subject.renderer.origin
    origin = local_origin(subject.scene.train.cameras)
    with tempfile.TemporaryDirectory() as folder:
        made: Any = subject.renderer
        files = [f for f in made.export(Path(folder)) if f.suffix == ".ply" and _is_splats(f)]
        if not files:
            raise ConfigError(
                f"{(subject.record or {}).get('method')} exports no Gaussians",
                where=options.run,
                todo="--format glb, obj, or ply --mesh",
            )
        return read_ply(files[0], origin), origin


def _write_mesh(options: Options, target: Path) -> list[Path]:
    import torch

    from visdom_plugin.export import meshes
    from visdom_plugin.export.upright import upright

    subject = open_subject(options.run, options, options.device, test=False)
    hull = _need_hull(subject)
    mesh = _find_surface(options, subject, hull)
    if options.crop == "hull":
        mesh = meshes.crop(mesh, lambda x: _contains(hull, x))
    mesh = meshes.smooth(meshes.largest_pieces(mesh, options.pieces), options.smooth)
    if options.upright:
        centre = torch.as_tensor(hull.centre)
        motion = upright(subject.scene.train.cameras, centre, _UP[options.format])
        mesh = meshes.move(mesh, motion.numpy())
    meshes.write_mesh(target, mesh)
    _say(options, f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")
    return [target]


def _contains(hull: Hull, points: np.ndarray) -> np.ndarray:
    return hull.contains(points, margin_voxels=1)


def _find_surface(options: Options, subject: Subject, hull: Hull) -> Mesh:
    from visdom_plugin.export.fusion import fuse
    from visdom_plugin.export.meshes import Mesh

    own = getattr(subject.renderer, "mesh", None)
    found: Mesh | None
    if options.surface == "density":
        if own is None:
            raise ConfigError(
                "only radiance fields have a density to find a surface in",
                where="--surface density",
                todo="--surface depth",
            )
        made = own(options.resolution)
        found = None if made is None else Mesh(*made)
    else:
        found = fuse(
            subject.renderer,
            subject.scene.train.cameras,
            hull.extent,
            resolution=options.resolution,
            inside=lambda x: hull.contains(x, margin_voxels=1),
            device=subject.device,
        )
    if found is None:
        raise ConfigError(
            "there is no surface: nowhere is the reconstruction half opaque",
            where=options.run,
            cause="the training has hardly begun, or failed",
        )
    return found


def _need_hull(subject: Subject) -> Hull:
    hull = subject.hull or _carve(subject.scene.train)
    if hull is None:
        raise ConfigError(
            "the default hull of the training views is empty, so the object's place is unknown",
            todo="look at the masks: visdom-check",
        )
    return hull


def _carve(views: Any) -> Hull | None:
    from visdom_plugin.training.evaluate import carve_reference

    return carve_reference(views)


def _say(options: Options, text: str) -> None:

    if not options.quiet:
        say(text)


if __name__ == "__main__":
    sys.exit(main())
