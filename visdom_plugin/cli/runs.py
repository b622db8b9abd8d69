"""Runs as commands make, find and open them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datamodules.built_in import on_disk
from visdom_plugin.cli import options
from visdom_plugin.cli.scenes import make_data_manager, open_scene
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import CheckpointError, ConfigError
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.scene import Scene, hold_out

if TYPE_CHECKING:
    from visdom_plugin.training.run import OnFinished


def train_as_asked(
    request: options.Request,
    scene,
    run_dir: Path,
    device: str,
    on_finished: OnFinished | None = None,
    tensorboard: Path | None = None,
) -> dict[str, Any]:
    """`training.run.train` with what the command line says; run.json's content."""
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
        on_finished=on_finished,
        tensorboard=tensorboard,
        snapshots=common.snapshots,
    )


def refuse_large_k(config: Any, scene: Scene) -> None:
    """Raises ConfigError where the K of a method's hull is above the number of training views with a mask."""
    hull, views = getattr(config, "hull", None), len(scene.train.with_masks())
    if isinstance(hull, HullSettings) and views:
        hull.require_views(views)


def default_run_dir(scene: str, views: int, method: str, seed: int) -> Path:
    """runs/<scene>/<views>/<method>/<seed>, below the working directory."""
    safe, named = (re.sub(r"[^\w.+-]+", "_", word).strip(".") for word in (scene, method))
    return Path("runs") / (safe or "scene") / str(views) / named / str(seed)


def load_again(record: dict[str, Any], run: Path, data: Path | None, *, test: bool = True) -> Scene:
    """The scene a run was trained and measured on: the views that run.json lists, whatever lists say by now.

    Args:
        record: run.json's content.
        data: where the scene lies now, when it has moved.
        test: False leaves the test views out, for who looks at none of them.

    Raises:
        CheckpointError: when what is found there is not what the run was trained on, or measured on.
        SceneError: when it cannot be read.
    """
    from visdom_plugin import registry
    from visdom_plugin.training.run import add_points

    noted = record["data"]
    path = data if data is not None else noted.get("path")
    folder = on_disk(path)
    if folder is not None and not folder.is_dir():
        raise CheckpointError(
            f"the run's scene is not at {path} any more", where=run, todo="say where it is with --data DIR"
        )
    scene = _open_noted(path, noted, run, test)
    scene = add_points(scene, registry.find(record["method"]), record["config"].get("hull"))
    refuse_other_scene(scene, record, run, f"the scene at {path or '(built-in)'}", test=test)
    return scene


def refuse_other_scene(
    scene: Scene, record: dict[str, Any], run: Path, named: str, *, test: bool = True
) -> None:
    """Sees to it that a scene is the one of a run.

    Args:
        named: the scene, for the error message.
        test: False leaves the test views out.

    Raises:
        CheckpointError: it is not.
    """
    from visdom_plugin.training.runs.run_directory import hash_views

    parts = [("train_views", scene.train, "trained")] + [("test_views", scene.test, "measured")] * test
    for name, views, used in parts:
        if hash_views(views) != record["data"]["hashes"][name]:
            raise CheckpointError(
                f"{named} is not the one this run was {used} on",
                where=f"{run}: {name.replace('_', ' ')}",
                cause="the images, masks or poses were changed, or another version of the software reads them",
                todo="pass the right folder with --data DIR, or train again with another --out",
            )


def _open_noted(path: Path | None, noted: dict[str, Any], run: Path, test: bool) -> Scene:
    """The scene of a run.json's entry `data`, not yet compared with it."""
    from visdom_plugin.training.missing_masks import fill_masks

    asked = {name: noted[name] for name in options.READING if name in noted}
    # What was held out is read as it was then, as a training view.
    held = [noted["held_out"]] if "held_out" in noted else []
    if on_disk(path) is not None:
        asked |= _list_views([*noted["train"], *held], [] if held else noted["test"])
        asked["frame"] = noted.get("frame_number")
    try:
        looked_at = test and bool(noted["test"]) and not held
        scene = open_scene(path, **asked, fill=False, test=looked_at, hold_out=not held)
    except ConfigError as error:
        raise CheckpointError(
            f"the scene at {path} does not have the views of this run",
            where=run,
            cause=error.what,
            todo="pass the right folder with --data DIR",
        ) from error
    if held and held[0] in scene.train.names:
        scene = hold_out(scene, scene.train.names.index(held[0]))
    return fill_masks(scene, asked.get("missing_masks", "error"))


def _list_views(train: Sequence[str], test: Sequence[str]) -> dict[str, Any]:
    """Options on reading that ask for views by name."""
    if any("," in name or name.isdecimal() for name in (*train, *test)):
        # Such names cannot be listed, or could be positions; the lists of then are asked, and the hashes tell.
        return {}
    # A comma after the last name, so that a single one is not taken for the name of a list.
    train_list, test_list = ("".join(f"{name}," for name in names) or None for names in (train, test))
    return {"views": len(train), "train_list": train_list, "test_list": test_list, "split": None}


@phase("reading the run")
def open_run(run: Path, data: Path | None, device_name: str, *, test: bool = True):
    """A trained method with its scene: (record, config, scene, method, hull, device, step).

    Args:
        test: False leaves the test views out.

    Raises:
        CheckpointError: when `run` is no run directory or has no checkpoint.
    """
    import torch

    from visdom_plugin import registry
    from visdom_plugin.training.run import restore
    from visdom_plugin.training.runs.config_io import from_plain
    from visdom_plugin.training.runs.run_directory import read_record

    record = read_record(run)
    preset = registry.find(record["method"])
    config = from_plain(preset.full, record["config"], str(run / "run.json"))
    device = torch.device(options.resolve_device(device_name))
    scene = load_again(record, run, data, test=test)
    method, hull, step = restore(preset, config, scene.train, run, device=device, seed=record["seed"])
    return record, config, scene, method, hull, device, step
