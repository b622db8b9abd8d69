"""visdom-train: from photographs to a trained, measured reconstruction."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from visdom_plugin.cli import entry, options


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_train, argv)


def _train(argv: Sequence[str]) -> None:
    request = options.parse(argv)
    common = request.common
    if common.show_config:
        sys.stdout.write(options.dump(request))
        return
    device = options.resolve_device(common.device)

    from visdom_plugin.cli.commands.check import warn_of_faults
    from visdom_plugin.cli.report import say, show_result
    from visdom_plugin.cli.scenes import open_scene
    from visdom_plugin.scene import describe_masks

    scene = open_scene(common.data, **options.read_options(common))
    folder = common.out or default_run_dir(scene.name, len(scene.train), request.preset.name, common.seed)
    if not common.quiet:
        data = "the built-in scene" if common.data is None else common.data
        say(
            f"{request.preset.name} on {data} ({scene.name}): {len(scene.train)} training views, {request.note}"
        )
        for line in (*describe_masks(scene.train), *scene.notes):
            say(f"data: {line}")
        say(f"run directory: {folder}")
        warn_of_faults(scene)
    record = train_as_asked(request, scene, folder, device)
    if not common.quiet:
        if record["already_finished"]:
            say("this run is finished already; nothing was done (train again with --overwrite)")
        elif record["resumed_from"] is not None:
            say(f"resumed after step {record['resumed_from']}")
        show_result(record, folder)


def train_as_asked(request: options.Request, scene, run_dir: Path, device: str) -> dict[str, Any]:
    """`training.run.train` with what the command line says; run.json's content."""
    from visdom_plugin.cli.scenes import make_data_manager
    from visdom_plugin.training.run import train

    common = request.common
    return train(
        request.preset.name,
        request.config,
        scene,
        data_manager=make_data_manager,
        run_dir=run_dir,
        device=device,
        seed=common.seed,
        quiet=common.quiet,
        overwrite=common.overwrite,
        checkpoint_seconds=common.checkpoint_seconds,
        budget=common.budget,
        request=options.describe_reading(common),
    )


def default_run_dir(scene: str, views: int, method: str, seed: int) -> Path:
    """runs/<scene>/<views>/<method>/<seed>, below the working directory."""
    safe = re.sub(r"[^\w.+-]+", "_", scene).strip(".") or "scene"
    return Path("runs") / safe / str(views) / method / str(seed)


if __name__ == "__main__":
    sys.exit(main())
