"""visdom-view: a scene, runs or a file of Gaussians in the browser."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.options import Device, SceneOptions, read_options
from visdom_plugin.cli.output.terminal import load_torch, say
from visdom_plugin.cli.subject import PointCloud, is_run, is_splat_file, open_subject, refuse_missing
from visdom_plugin.errors import CheckpointError, ConfigError
from visdom_plugin.viewer.serve import choose_port, describe_address, require_viser

if TYPE_CHECKING:
    from torch import Tensor

    from visdom_plugin.export.meshes import Mesh
    from visdom_plugin.splat.gaussians import Gaussians
    from visdom_plugin.viewer.shown import Reconstruction, Subject


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Shows a scene, a run, two runs, or a file of Gaussians in the browser.

    Cameras with their photographs, the hull, Gaussians or mesh, and, where the camera rests, what the method
    renders. A run that is still training is followed from checkpoint to checkpoint. Needs the extra `viewer`.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run directory, folder of a scene, builtin:NAME, or a .ply, .spz, .splat or .sog file; by default the
    built-in scene."""
    beside: Path | None = None
    """A second run on the same scene, to compare with."""
    wait: bool = False
    """Wait for a run that is about to begin, until it has a state to show."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets the whole network in."""
    port: int | None = None
    """Port to listen at; by default the first free one from 8080."""
    device: Device = "auto"
    """Where to compute."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_view, argv)


def _view(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-view")
    what = options.what
    require_viser()
    if what is not None and options.wait:
        wait_for_state(what)
    refuse_missing(what)
    choose_port(options.host, options.port)
    load_torch()
    from visdom_plugin.viewer.app import Viewer

    subject = open_shown(options)
    # Reading takes a while, in which somebody else may have taken it.
    viewer = Viewer(subject, options.host, choose_port(options.host, options.port))
    address, hint = describe_address(options.host, viewer.server.get_port())
    sys.stdout.write(f"{address}\n")
    sys.stdout.flush()
    if not options.quiet:
        say(f"{hint}\nCtrl-C ends it")
    try:
        viewer.wait()
    except KeyboardInterrupt:
        pass  # as was said
    finally:
        viewer.stop()


def wait_for_state(run: Path, seconds: float = 0.5) -> None:
    """Returns when a run directory holds a checkpoint; looks every so many seconds."""
    import time

    from visdom_plugin.training.runs.checkpoints import list_steps

    while not (is_run(run) and list_steps(run / "checkpoints")):
        time.sleep(seconds)


def open_shown(options: Options) -> Subject:
    """What the options name, ready to be shown.

    Raises:
        ConfigError, CheckpointError, SceneError: it cannot be.
    """
    from visdom_plugin.training.evaluate import carve_reference
    from visdom_plugin.viewer.shown import Subject

    what = options.what
    paths = [p for p in (what, options.beside) if p is not None and (is_run(p) or is_splat_file(p))]
    if options.beside is not None and len(paths) != 2:
        raise ConfigError(
            "two runs are compared, and one of these is none",
            where=f"{what}, --beside {options.beside}",
            todo="give two run directories on the same scene",
        )
    if not paths:
        from visdom_plugin.cli.scenes import open_scene

        scene = open_scene(
            what or options.data, **read_options(options) | {"missing_masks": "colour"}, fill=False
        )
        return Subject(scene, carve_reference(scene.train))
    opened = [open_subject(path, options, options.device, test=True) for path in paths]
    names = [tuple(o.scene.train.names) + tuple(o.scene.test.names) for o in opened]
    if len(set(names)) > 1:
        raise CheckpointError("the two runs are of different scenes or views", where=options.beside)
    runs = tuple(_shown(path, found, n) for n, (path, found) in enumerate(zip(paths, opened, strict=True)))
    hull = next((o.hull for o in opened if o.hull is not None), None)
    first = paths[0]
    saved = first / "camera_path.json" if is_run(first) else first.with_name(f"{first.stem}_camera_path.json")
    return Subject(opened[0].scene, hull or carve_reference(opened[0].scene.train), runs, first, saved)


def _shown(path: Path, found: Any, number: int) -> Reconstruction:
    from visdom_plugin.viewer.shown import Reconstruction

    name = path.name if found.record is None else found.record["method"]
    own: Any = found.renderer

    def gaussians() -> tuple[Gaussians, Tensor] | None:
        if isinstance(own, PointCloud):
            return own.gaussians, own.origin
        splats = getattr(own, "splats", None)
        return None if splats is None else (splats.gaussians(), own.origin)

    def mesh() -> Mesh | None:
        from visdom_plugin.export.meshes import Mesh

        made = getattr(own, "mesh", lambda _: None)(96)
        return None if made is None else Mesh(*made)

    refresh = (lambda: None) if found.record is None else _follow(path, own)
    return Reconstruction(f"{number + 1}: {name}", own, found.device, gaussians, mesh, refresh)


def _follow(path: Path, method: Any) -> Any:
    """A function that loads a run's newest checkpoint where it is newer than the last one loaded."""
    from visdom_plugin.training.runs import checkpoints

    folder = path / "checkpoints"
    last = max(checkpoints.list_steps(folder), default=-1)

    def refresh() -> int | None:
        nonlocal last
        newest = max(checkpoints.list_steps(folder), default=-1)
        if newest <= last:
            return None
        last = newest
        try:
            method.load_state_dict(checkpoints.load(folder, newest).tensors)
        except CheckpointError:  # It was replaced by a newer one while it was read.
            return None
        return newest

    return refresh


if __name__ == "__main__":
    sys.exit(main())
