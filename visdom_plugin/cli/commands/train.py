"""visdom-train: trains a method on posed, masked photographs and measures it."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from visdom_plugin.cli import entry, options
from visdom_plugin.cli.output.reports import SMALL_PX, SWIFT_PX, swift_factor
from visdom_plugin.cli.output.terminal import load_torch, say, show_next, show_result
from visdom_plugin.compute.ahead import prepare, training_job
from visdom_plugin.errors import count_of
from visdom_plugin.viewer.serve import require_viser

if TYPE_CHECKING:
    from visdom_plugin.geometry.cameras import Cameras


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_train, argv)


def _train(argv: Sequence[str]) -> None:
    request = options.parse(argv)
    common = request.common
    if common.show_config:
        sys.stdout.write(options.dump(request))
        return
    common.find_scene_folder()
    options.refuse_large_k(common, getattr(request.config, "hull", None))
    if common.view:
        require_viser()
    quiet = common.quiet
    if not quiet:
        data = "the built-in scene" if common.data is None else common.data
        say(f"{request.preset.name} on {data}, {request.note}")
    if not options.may_use_cuda(common.device):
        prepare(training_job(request.preset.name))
    load_torch()
    device = options.resolve_device(common.device)

    from visdom_plugin.cli.commands.check import warn_of_faults
    from visdom_plugin.cli.runs import default_run_dir, refuse_large_k, train_as_asked
    from visdom_plugin.cli.scenes import open_scene
    from visdom_plugin.scene import describe_masks

    scene = open_scene(common.data, **options.read_options(common))
    refuse_large_k(request.config, scene)
    folder = common.out or default_run_dir(scene.name, len(scene.train), request.preset.name, common.seed)
    if not quiet:
        counts = (count_of(len(scene.train), "training view"), count_of(len(scene.test), "test view"))
        say(f"data: {scene.name}, {', '.join(counts)}")
        if common.budget == "standard" and len(scene.train) < request.preset.standard_views:
            say(
                f"budget standard gains from {request.preset.standard_views} views on; with {len(scene.train)}, "
                "--budget quick was seen to be better, and is faster"
            )
        for line in (*describe_masks(scene.train), *scene.notes):
            say(f"data: {line}")
        if common.budget == "quick" and (note := _describe_size(scene.train.cameras, common.downscale)):
            say(note)
        say(f"run directory: {folder}")
    warn_of_faults(scene, inverted=common.invert_masks)
    on_finished = None
    if common.report:
        from functools import partial

        from visdom_plugin.cli.commands.check import find_briefly
        from visdom_plugin.cli.output.reports import report_finished

        on_finished = partial(report_finished, scene=scene, run_dir=folder, device=device, check=find_briefly)
    with watching(folder) if common.view else nullcontext():
        record = train_as_asked(request, scene, folder, device, on_finished, common.tensorboard)
    if not quiet:
        if record["already_finished"]:
            say("this run is finished already; nothing was done (train again with --overwrite)")
        elif record["resumed_from"] is not None:
            say(f"resumed after step {record['resumed_from']}")
        show_result(record, folder)
        show_next(folder)


def _describe_size(cameras: Cameras, downscale: float) -> str | None:
    """What to say of pictures that are too large for quick schedules, or too small; None of others."""
    width, height = max((camera.size for camera in (cameras[i] for i in range(len(cameras)))), key=math.prod)
    factor = swift_factor(downscale, max(width, height))
    if max(width, height) < SMALL_PX:
        smaller = "; leave out --downscale" if downscale > 1 else ""
        return (
            f"the photographs have {width} x {height} pixels, of which little can be learnt{smaller}: "
            f"budget quick is made for {SMALL_PX} to {SWIFT_PX}"
        )
    if factor == downscale:
        return None
    return (
        f"the photographs have {width} x {height} pixels, and budget quick is made for {SMALL_PX} to {SWIFT_PX}: "
        f"it will take long. Quicker: --downscale {factor:g}"
    )


@contextmanager
def watching(folder: Path) -> Iterator[None]:
    """A block during which visdom-view shows the run of a folder, in a process of its own."""
    import subprocess

    words = [sys.executable, "-m", "visdom_plugin.cli.commands.view", str(folder), "--wait"]
    viewer = subprocess.Popen(words)
    try:
        yield
    finally:
        viewer.terminate()
        viewer.wait()


if __name__ == "__main__":
    sys.exit(main())
