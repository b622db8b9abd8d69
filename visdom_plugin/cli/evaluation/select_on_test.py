"""What choosing a snapshot by its test views is worth: a number to judge others' results by, never a result.

The VisDom authors' release measures 3DGS-GO ten times while it trains, on the test views, and reports the best.
The maximum of such measurements is never below the last one, whatever the method.
"""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from visdom_plugin.atomic_files import finite
from visdom_plugin.errors import CheckpointError, SceneError
from visdom_plugin.scene import Views
from visdom_plugin.training.evaluate import evaluate
from visdom_plugin.training.protocols import Method
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.runs.run_directory import Record, RunDir
from visdom_plugin.training.trainer import SNAPSHOTS

log = logging.getLogger(__name__)

WARNING = "chosen on the test views; not a result of the method"


def find_snapshots(run_dir: Path) -> list[int]:
    """Steps of the snapshots that a run kept.

    Raises:
        CheckpointError: there are none.
    """
    steps = checkpoints.list_steps(Path(run_dir) / SNAPSHOTS)
    if not steps:
        raise CheckpointError(
            "the run kept no snapshots to choose from",
            where=run_dir,
            todo="train it again with --snapshots 10 --overwrite",
        )
    return steps


def select_on_test(method: Method, views: Views, *, device: torch.device, run_dir: Path) -> Record:
    """Measures every snapshot of a run on the test views and notes the one of the highest mean PSNR.

    Args:
        method: of that run, set up; left in the state of the last snapshot.
        views: the test views.

    Returns:
        run.json, whose `metrics` stay those of the last step; `selected_on_test` has "step", "by_step" with the
        means of every snapshot, and a "warning".

    Raises:
        CheckpointError: when the run kept no snapshots, one is damaged, or a process is training into the
            directory.
        SceneError: when no test view can be measured.
    """
    folder, steps = Path(run_dir) / SNAPSHOTS, find_snapshots(run_dir)
    if all(views.mask_origin(i) != "given" for i in range(len(views))):
        raise SceneError(
            "the scene has no test view that can be measured, so that there is nothing to choose by",
            where=run_dir,
        )
    with RunDir.open_existing(run_dir) as run:
        by_step = {}
        for step in steps:
            method.load_state_dict(checkpoints.load(folder, step).tensors)
            found: Record = evaluate(method, views, reference_hull=None, device=device)
            by_step[step] = found["test"]
            log.info("snapshot after step %d: %.2f dB on the test views", step, by_step[step]["psnr"])
        best = max(steps, key=lambda step: by_step[step]["psnr"])
        run.update(selected_on_test=finite({"warning": WARNING, "step": best, "by_step": by_step}))
        return run.record
