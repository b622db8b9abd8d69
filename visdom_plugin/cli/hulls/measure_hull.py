"""Carves one hull, measures it against the true surface and leaves a run directory, as visdom-table asks for it.

python -m visdom_plugin.cli.hulls.measure_hull --data DIR --views 4 --method.hull.kind traditional
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from visdom_plugin import registry
from visdom_plugin.cli import entry, options
from visdom_plugin.cli.early import WORD
from visdom_plugin.errors import ConfigError
from visdom_plugin.training.hull_run.config import METHOD, HullRunConfig

if TYPE_CHECKING:
    from visdom_plugin.scene import Scene

PRESET = registry.Preset(
    METHOD,
    "the hull alone, measured against the true surface",
    "visdom_plugin.training.hull_run.run:measure_hull",
    HullRunConfig(),
    HullRunConfig(),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_measure, argv)


def find(name: str) -> registry.Preset:
    """The one preset of this command.

    Raises:
        ConfigError: for the name of anything else.
    """
    if name != METHOD:
        raise ConfigError(f"this command measures hulls, not {name!r}", todo=f"visdom-train method:{name}")
    return PRESET


def _measure(argv: Sequence[str]) -> None:
    words = [*argv, WORD + METHOD]
    request = options.parse(words, prog="python -m visdom_plugin.cli.hulls.measure_hull", find=find)
    common = request.common
    if common.show_config:
        sys.stdout.write(options.dump(request))
        return

    from visdom_plugin.cli.output.terminal import say
    from visdom_plugin.cli.runs import default_run_dir
    from visdom_plugin.cli.scenes import open_scene
    from visdom_plugin.training.hull_run.run import carve_run

    scene = open_scene(common.data, **options.read_options(common), fill=False)
    scene = with_target(scene, common.data, request.config.target)
    folder = common.out or default_run_dir(scene.name, len(scene.train), METHOD, common.seed)
    record = carve_run(
        request.config,
        scene,
        run_dir=folder,
        seed=common.seed,
        overwrite=common.overwrite,
        budget=common.budget,
        request=options.describe_reading(common),
    )
    if not common.quiet:
        say(f"run directory: {folder}")
        for name, value in record["metrics"]["test"].items():
            sys.stdout.write(f"{name:24s} {'-' if value is None else format(value, '.6g')}\n")


def find_target(root: Path | None, given: str | None, frame: int | None) -> Path | None:
    """The mesh file of the true surface: the one given, else the scene's own; None where there is none.

    Args:
        root: the scene's folder, or the name of a built-in scene, which knows its surface.
        given: a mesh file that the user names.
        frame: of a video layout.
    """
    from datamodules.built_in import on_disk
    from datamodules.files.target_mesh import find_mesh

    if given is not None:
        return Path(given).expanduser()
    folder = on_disk(root)
    return None if folder is None else find_mesh(folder, frame)


def with_target(scene: Scene, root: Path | None, given: str | None) -> Scene:
    """The scene with the mesh of its true surface, where there is one.

    Args:
        root: the scene's folder.
        given: a mesh file that the user names.
    """
    import hashlib

    from datamodules.files.paths import read_plain
    from datamodules.files.target_mesh import load_mesh

    path = find_target(root, given, scene.source.get("frame_number"))
    if path is None:
        return scene
    mesh = load_mesh(path, scene.source.get("aabb"))
    print_of = hashlib.sha256(read_plain(path)).hexdigest()
    hashes = {**scene.source.get("hashes", {}), "target_mesh": print_of}
    return replace(scene, mesh=mesh, source={**scene.source, "hashes": hashes})


if __name__ == "__main__":
    sys.exit(main())
