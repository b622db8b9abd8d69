"""What commands show, draw and export: a run's trained method, or a file of Gaussians, with its scene and hull."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datamodules.built_in import on_disk
from visdom_plugin.cli.options import SceneOptions, read_options, resolve_device
from visdom_plugin.errors import ConfigError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from visdom_plugin.geometry.cameras import Cameras
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.render import Render
    from visdom_plugin.scene import Scene
    from visdom_plugin.splat.gaussians import Gaussians
    from visdom_plugin.training.evaluate import Renderer


@dataclass(frozen=True)
class Subject:
    """What is drawn, with the scene whose cameras look at it."""

    scene: Scene
    renderer: Renderer
    hull: Hull | None
    """The method's; None where it has none."""
    device: torch.device
    record: dict[str, Any] | None = None
    """run.json's content, where it is a run."""


@dataclass(frozen=True)
class PointCloud:
    """Gaussians that render as a trained method does."""

    gaussians: Gaussians
    origin: Tensor
    """(3,) float64 of their frame, in the cameras' frame."""
    near: float
    """Where pictures begin, see `splat.rasterise`."""

    def render(self, camera: Cameras, background: Tensor) -> Render:
        """Their picture; `splat.rasterise` has the details."""
        from visdom_plugin.splat.rasterise import rasterise

        return rasterise(self.gaussians, camera.relative_to(self.origin), background, near=self.near)


def is_splat_file(path: Path) -> bool:
    """Whether a path is that of a file of Gaussians, by its name."""
    return path.suffix.lower() in (".ply", ".spz", ".splat", ".sog") and not path.is_dir()


def is_run(path: Path) -> bool:
    """Whether a folder is a run directory."""
    return (path / "run.json").is_file()


def refuse_missing(path: Path | None) -> None:
    """Refuses a path at which there is nothing, before anything is loaded; built-in scenes have none.

    Raises:
        ConfigError: there is no such file or folder.
    """
    place = on_disk(path)
    if place is not None and not place.exists():
        raise ConfigError(
            "there is no such file or folder",
            where=path,
            todo="name a run directory, as visdom-train does at its end, a file of Gaussians, or a scene's folder",
            topic="no-scene",
        )


def open_subject(path: Path, options: SceneOptions, device: str, *, test: bool) -> Subject:
    """A run, or a file of Gaussians, by its path; `open_trained` and `open_point_cloud`."""
    return (open_point_cloud if is_splat_file(path) else open_trained)(path, options, device, test=test)


def open_trained(path: Path, options: SceneOptions, device: str, *, test: bool) -> Subject:
    """A run's state, with the scene it was trained on.

    Args:
        test: False leaves the test views out.

    Raises:
        ConfigError: an option says how to read a scene, which run.json says already.
        CheckpointError: `path` is no run directory or has no checkpoint.
    """
    from visdom_plugin.cli.runs import open_run

    for field in fields(SceneOptions):
        if field.name not in ("data", "quiet") and getattr(options, field.name) != field.default:
            raise ConfigError(
                "a run's scene is read as it was for its training",
                where=f"--{field.name.replace('_', '-')}",
                todo="leave it out; it goes with a .ply file",
            )
    record, _, scene, method, hull, where, _ = open_run(path, options.data, device, test=test)
    return Subject(scene, method, hull, where, record)


def open_point_cloud(path: Path, options: SceneOptions, device: str, *, test: bool) -> Subject:
    """Gaussians from a file, with the scene whose cameras look at them; masks it need not have.

    Raises:
        SceneError: the file is no point cloud of Gaussians, or the scene cannot be read.
    """
    import torch

    from visdom_plugin.cli.output.terminal import say
    from visdom_plugin.cli.scenes import open_scene
    from visdom_plugin.export.splat_files import read_splats
    from visdom_plugin.geometry.local_frame import local_origin, mean_distance
    from visdom_plugin.splat.rasterise import NEAR

    where = torch.device(resolve_device(device))
    reading = read_options(options) | {"missing_masks": "colour"}
    scene = open_scene(options.data, **reading, fill=False, test=test)
    # Float32 holds them near the scene only, wherever the file's frame has its origin.
    origin = local_origin(scene.train.cameras)
    gaussians = read_splats(path, origin).to(where)
    if not options.quiet:
        whose = " (--data DIR names another scene)" if options.data is None else ""
        say(f"{len(gaussians)} Gaussians seen by the cameras of {scene.name}{whose}")
    near = NEAR * float(mean_distance(scene.train.cameras))
    return Subject(scene, PointCloud(gaussians, origin, near), None, where)
