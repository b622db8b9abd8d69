"""visdom-convert: cameras of a COLMAP model as ActorsHQ's calibration.csv, and the other way round."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.output.terminal import load_torch
from visdom_plugin.errors import ConfigError, SceneError, list_some

TABLE = "calibration.csv"


@dataclass(frozen=True)
class Options:
    """Convert cameras between a COLMAP model and ActorsHQ's calibration.csv, whichever SOURCE is.

    Sizes, intrinsics and poses are kept to 1e-6 or better. A model's points and 2D points have no place in the
    table and are left out; so have lens distortions, which are refused.
    """

    source: tyro.conf.Positional[Path]
    """COLMAP model (cameras and images, .bin or .txt) or a scene with one; or calibration.csv, or its folder."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Of a model: the .csv to write. Of a table: the folder for the model, such as SCENE/sparse/0."""
    image_names: str = "{name}.jpg"
    """Of a table: names of the model's photographs. ActorsHQ's of frame 12 are {name}/{name}_rgb000012.jpg."""
    overwrite: bool = False
    """Replace files that are there."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_convert, argv)


def _convert(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-convert")
    source = options.source.expanduser()
    if not source.exists():
        raise SceneError(
            "there is no such file or folder", where=source, todo="name a model or calibration.csv"
        )
    table = _find_table(source)
    load_torch()
    count, made = _to_table(source, options) if table is None else _to_model(table, options)
    sys.stdout.write(f"{count} cameras: {made}\n")


def _find_table(source: Path) -> Path | None:
    """The calibration.csv that is meant; None where a model is."""
    if source.is_file():
        if source.suffix.lower() == ".csv":
            return source
        raise SceneError(
            "this file is no .csv", where=source, todo="name calibration.csv, or a model's folder"
        )
    tables = [p for p in (source / TABLE, *sorted(source.glob(f"[124]x/{TABLE}"))) if p.is_file()]
    if len(tables) > 1:
        raise SceneError(
            f"there are {len(tables)} tables: {list_some(str(p.relative_to(source)) for p in tables)}",
            where=source,
            todo=f"name one: {tables[0]}",
        )
    return tables[0] if tables else None


def _to_model(table: Path, options: Options) -> tuple[int, Path]:
    from datamodules.files.paths import check_name, read_file
    from datamodules.layouts.actorshq import cameras_of, parse_calibration
    from visdom_plugin.export.dataset import write_colmap

    folder, pattern = options.out, options.image_names
    if folder.suffix.lower() == ".csv" or folder.is_file():
        raise ConfigError("a table is converted to a model, which is a folder", where=f"--out {folder}")
    try:
        example = pattern.format(name="Cam001")
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"no name can be made of this: {error}", where=f"--image-names {pattern}"
        ) from error
    if "Cam001" not in example:
        raise ConfigError(
            "all photographs would have one name", where=f"--image-names {pattern}", todo="use {name}"
        )
    _refuse_replacing([folder / f"{part}.bin" for part in ("cameras", "images", "points3D")], options)
    rows = parse_calibration(read_file(table), table)
    names = [pattern.format(name=row["name"]) for row in rows]
    for name in names:
        check_name(name, table)
    cameras = cameras_of(rows, table)
    write_colmap(folder, [cameras[i] for i in range(len(cameras))], names)
    return len(rows), folder


def _to_table(source: Path, options: Options) -> tuple[int, Path]:
    from datamodules.files.colmap_model import cameras_of, read_model
    from datamodules.files.find_model import choose_model
    from visdom_plugin.export.calibration_csv import write_calibration

    if options.out.suffix.lower() != ".csv":
        todo = f"--out {options.out / TABLE}"
        raise ConfigError(
            "a model is converted to a table, a .csv file", where=f"--out {options.out}", todo=todo
        )
    folder, said = choose_model(source, None)
    if folder is None:
        raise SceneError(
            "there is neither a COLMAP model nor calibration.csv",
            where=source,
            todo="name the folder with cameras.bin and images.bin (or .txt), or the one with calibration.csv",
        )
    for line in said:
        sys.stderr.write(f"{line}\n".replace("--colmap-model", "its folder as SOURCE"))
    _refuse_replacing([options.out], options)
    model = read_model(source, folder)
    images = sorted(model.images, key=lambda image: image.name)
    cameras, distortions = cameras_of(model, images)
    bent = [image.name for image, bend in zip(images, distortions, strict=True) if bend is not None]
    if bent:
        raise SceneError(
            f"{len(bent)} of {len(images)} cameras have a lens distortion, which calibration.csv cannot hold",
            where=model.folder,
            todo="undistort first (colmap image_undistorter) and convert the model that this writes",
        )
    names = [_camera_name(image.name) for image in images]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None or not images:
        raise SceneError(
            f"two photographs would be of camera {twice}" if images else "the model has no photographs",
            where=model.folder,
            cause="several frames or folders in one model: the table has one row per camera"
            if images
            else None,
            todo="convert a model of one photograph per camera, named after it" if images else None,
        )
    write_calibration(options.out, cameras, names)
    return len(images), options.out


def _camera_name(image: str) -> str:
    """Cam001 of Cam001/Cam001_rgb000012.jpg and of Cam001.jpg."""
    return re.sub(r"_rgb\d+$", "", PurePosixPath(image.replace("\\", "/")).stem)


def _refuse_replacing(files: Sequence[Path], options: Options) -> None:
    there = [path for path in files if path.exists()]
    if there and not options.overwrite:
        raise ConfigError(
            f"{list_some(str(path) for path in there)} is there already",
            where=f"--out {options.out}",
            todo="name another place, or pass --overwrite",
        )


if __name__ == "__main__":
    sys.exit(main())
