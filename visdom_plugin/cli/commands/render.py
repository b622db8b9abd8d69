"""visdom-render: draws a run, or any 3DGS point cloud, along a camera path."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.options import Device, SceneOptions
from visdom_plugin.cli.subject import is_splat_file, open_subject
from visdom_plugin.errors import ConfigError

if TYPE_CHECKING:
    from visdom_plugin.geometry.cameras import Cameras
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Renders a run from its last checkpoint along a camera path, on white.

    In place of a run it takes the point_cloud.ply of any 3DGS, whoever trained it, and draws it with the cameras
    of the scene that --data names: visdom-render point_cloud.ply --data DIR --path train
    """

    run: tyro.conf.Positional[Path]
    """Run directory, as visdom-train names it, or a .ply, .spz, .splat or .sog file of Gaussians."""
    path: Literal["orbit", "between", "train", "test"] = "orbit"
    """orbit: a circle round the object; between: from training view to training view; train, test: these views."""
    frames: int = 60
    """Number of frames along orbit and between."""
    fps: int = 30
    """Frames per second of the video."""
    format: Literal["mp4", "png"] = "mp4"
    """A video, or a folder of numbered images."""
    out: Path | None = None
    """File or folder to write; by default <run>/renders/<path>.mp4 or <run>/renders/<path>_frames/, and for
    NAME.ply NAME_<path>.mp4 or NAME_<path>_frames/ beside it."""
    data: Path | None = None
    """Folder of the scene; for a run, only where its scene has moved."""
    device: Device = "auto"
    """Device to compute on."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_render, argv)


def _render(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=argv, prog="visdom-render")
    for name in ("frames", "fps"):
        if getattr(options, name) < 1:
            raise ConfigError(f"--{name} is {getattr(options, name)}; it must be at least 1")

    if options.format == "mp4" and options.out is not None and options.out.suffix.lower() != ".mp4":
        raise ConfigError(
            "the name of a video ends in .mp4",
            where=f"--out {options.out}",
            todo="--out NAME.mp4, or --format png for a folder of pictures",
        )

    from visdom_plugin.cli.report import say
    from visdom_plugin.figures.contact_sheet import to_bytes, write_png, write_video
    from visdom_plugin.training.evaluate import render_on_white

    subject = open_subject(options.run, options, options.device, test=options.path == "test")
    cameras = cameras_along(options.path, options.frames, subject.scene, subject.hull)
    target = options.out or default_target(options)
    if options.format == "png":
        clear_numbered(target, len(cameras), ours=options.out is None)
    elif len(set(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))) > 1:
        raise ConfigError(
            "the views differ in size, which a video cannot",
            where=f"--path {options.path}",
            todo="--format png",
        )
    frames = []
    for i in range(len(cameras)):
        picture = to_bytes(render_on_white(subject.renderer, cameras[i], subject.device)[0])
        if options.format == "png":
            write_png(target / f"{i:04d}.png", picture)
        else:
            frames.append(picture)
    if options.format == "mp4":
        codec = write_video(target, frames, options.fps)
        if not options.quiet:
            say(f"{len(frames)} frames, codec {codec}")
    if not options.quiet:
        sys.stdout.write(f"{target}\n")


def default_target(options: Options) -> Path:
    """Where a path's pictures go by default; not into renders/test, which is the evaluation's."""
    name = f"{options.path}.mp4" if options.format == "mp4" else f"{options.path}_frames"
    if is_splat_file(options.run):
        return options.run.with_name(f"{options.run.stem}_{name}")
    return options.run / "renders" / name


def clear_numbered(folder: Path, count: int, *, ours: bool) -> None:
    """Sees to it that no picture of a longer path stays beside the `count` that will be written.

    Args:
        ours: whether the folder is the run's own; in any other one nothing is removed.

    Raises:
        ConfigError: there are such pictures in a folder that is not the run's own.
    """
    later = [p for p in folder.glob("[0-9]" * 4 + "*.png") if p.stem.isdecimal() and int(p.stem) >= count]
    if later and not ours:
        raise ConfigError(
            f"the folder holds numbered pictures beyond the {count} of this path: {min(later).name}",
            where=folder,
            cause="a longer path was rendered into it",
            todo="remove them, or choose another folder with --out",
        )
    for picture in later:
        picture.unlink()


def cameras_along(path: str, frames: int, scene: Scene, hull: Hull | None) -> Cameras:
    """(frames,) cameras of a path; the views' own for "train" and "test".

    Raises:
        ConfigError: the path is along test views, and there are none.
    """
    import torch

    from visdom_plugin.geometry.camera_paths import interpolate, orbit
    from visdom_plugin.geometry.cameras import Cameras, look_at_point

    if path in ("train", "test"):
        if not len(getattr(scene, path)):
            raise ConfigError(f"there are no {path} views", where=f"--path {path}", todo="--path orbit")
        return getattr(scene, path).cameras
    cameras = scene.train.cameras
    centre = look_at_point(cameras) if hull is None else torch.as_tensor(hull.centre)
    if path == "orbit":
        return orbit(cameras, frames, centre)
    legs = max(len(cameras) - 1, 1)
    along = [i * legs / max(frames - 1, 1) for i in range(frames)]
    starts = [min(int(t), legs - 1) for t in along]
    size = (cameras.width[0], cameras.height[0])
    return Cameras.stack(
        [
            interpolate(cameras[s], cameras[min(s + 1, len(cameras) - 1)], t - s, centre).resized(*size)
            for s, t in zip(starts, along, strict=True)
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
