"""One training run from a scene to a finished run directory."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import torch

from visdom_plugin import registry
from visdom_plugin.atomic_files import appearing, finite
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import CheckpointError, ConfigError, EmptyHullError, PluginError, SceneError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Scene, Views
from visdom_plugin.specs import Settings, check_requirements
from visdom_plugin.training.evaluate import carve_reference, evaluate
from visdom_plugin.training.live import SHEET, Live, LivePictures, TensorBoard
from visdom_plugin.training.local_method import LocalMethod, move_near
from visdom_plugin.training.progress import Progress
from visdom_plugin.training.protocols import Batch, Hook, Method
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.training.runs.config_io import as_plain, differences
from visdom_plugin.training.runs.run_directory import Record, RunDir, describe_data, find_versions
from visdom_plugin.training.runs.saved_hulls import REFERENCE, find_hull, read_hull, write_hull
from visdom_plugin.training.trainer import Trainer, events_of, summarise, view_psnr
from visdom_plugin.training.training_views import draw_training_views, refuse_empty

log = logging.getLogger(__name__)


class Batches(Protocol):
    """What training draws of the views, pure functions of the step; `batches.DataManager` makes them."""

    def view_batch(self, step: int) -> Batch:
        """The whole view of a step."""

    def view(self, index: int) -> Batch:
        """A whole view by its number."""

    def pixel_batch(self, step: int, n: int) -> Batch:
        """`n` pixels of all views."""


DataManager = Callable[[Views, int, torch.device], Batches]
"""(training views, seed, device) to the batches."""


OnFinished = Callable[[Record, Method, "Hull | None"], None]
"""What is done with a run that has just finished: its record, its method and the method's hull."""


class Interrupted(KeyboardInterrupt):
    """A signal stopped the run; the same command resumes it from the last step saved."""


def add_points(scene: Scene, preset: registry.Preset, hull: object) -> Scene:
    """The scene with its points among the training views where training starts from them: Gaussians, no `hull`."""
    if preset.hook != "gaussian" or hull is not None:
        return scene
    return replace(scene, train=replace(scene.train, points=scene.points))


def train(
    preset_name: str,
    config: Settings,
    scene: Scene,
    *,
    data_manager: DataManager,
    run_dir: Path,
    device: str | torch.device = "cpu",
    seed: int = 0,
    quiet: bool = False,
    overwrite: bool = False,
    checkpoint_seconds: float = 30,
    request: Record | None = None,
    budget: str | None = None,
    on_finished: OnFinished | None = None,
    tensorboard: Path | None = None,
    snapshots: int = 0,
) -> Record:
    """Trains, evaluates and writes the run directory; resumes the same run where it was left.

    Nothing made of `scene.test` reaches the hull, the hooks or the method: they are handed `scene.train`.

    Args:
        preset_name: names the method's class; its settings are `config`.
        request: how the scene was asked for, so that it can be loaded again: path, seed, views, downscale.
        budget: noted in run.json.
        tensorboard: folder for TensorBoard's files, with numbers and pictures.
        on_finished: called at the end of a run that this call finishes; what it raises is logged, no
            more.
        snapshots: states to keep besides, evenly spaced over the schedule, for `visdom-eval --oracle`; the
            result does not depend on it.

    Returns:
        run.json's content, with `resumed_from` (step, or None) and `already_finished` added.

    Raises:
        CheckpointError: when `run_dir` belongs to another run or another process.
        EmptyHullError: when the config's hull is empty.
        TrainingError: when the optimisation diverges.
        Interrupted: after Ctrl-C or SIGTERM; the same call resumes it.
        PluginError: TensorBoard's files are asked for, and the package is not installed; or something is missing
            that the method needs, such as weights.
    """
    board = None if tensorboard is None else TensorBoard(tensorboard)
    preset = registry.find(preset_name)
    check_requirements(config)
    device = torch.device(device)
    scene = add_points(scene, preset, getattr(config, "hull", None))
    identity = {
        "method": preset.name,
        "scene": scene.name,
        "seed": seed,
        "config": as_plain(config),
        "data": describe_data(scene, request or {}),
    }
    defaults = as_plain(preset.settings(budget or "quick"))
    with RunDir.open(run_dir, finite(identity), overwrite=overwrite, defaults=defaults) as run:
        if run.record["status"] == "finished":
            return run.record | {"resumed_from": None, "already_finished": True}
        circumstances = {
            "device": str(device),
            "versions": find_versions(),
            "threads": torch.get_num_threads(),
        }
        _warn_of_changes(run.record, circumstances)
        run.update(status="running", budget=budget, **circumstances)
        try:
            resumed, method, hull = _run(
                preset,
                config,
                scene,
                run,
                data_manager,
                device,
                seed,
                quiet,
                checkpoint_seconds,
                board,
                snapshots,
            )
        except KeyboardInterrupt:
            run.update(status="interrupted")
            raise Interrupted from None
        except (SceneError, EmptyHullError, ConfigError, PluginError):
            # The user's mistake, found before the first step: no trace of it.
            run.discard()
            raise
        except BaseException as error:
            run.update(status="failed", error=f"{type(error).__name__}: {error}")
            raise
        finally:
            if board is not None:
                board.close()
        if on_finished is not None:
            try:
                on_finished(run.record, method, hull)
            except Exception as error:
                log.error("the run has finished, but not what was to follow: %r", error, exc_info=True)
        return run.record | {"resumed_from": resumed, "already_finished": False}


def _run(
    preset: registry.Preset,
    config: Settings,
    scene: Scene,
    run: RunDir,
    data_manager: DataManager,
    device: torch.device,
    seed: int,
    quiet: bool,
    checkpoint_seconds: float,
    board: TensorBoard | None,
    snapshots: int,
) -> tuple[int | None, Method, Hull | None]:
    """Where it went on from, and what was trained."""
    saved = run.path / "hull"
    method, hull, hull_s = build(preset, config, scene.train, device=device, seed=seed, saved=saved)
    if hull is not None:
        write_hull(hull, saved)
        # Of the run that carved it, not of one that goes on with it.
        hull_s = run.record.get("timing", {}).get("hull_s", hull_s)
        run.update(timing={"hull_s": hull_s})
    batches = data_manager(move_near(scene.train), seed, device)
    pictures = None
    if board is not None or not quiet:
        keep = {} if board is None else {"keep": board.picture}
        pictures = LivePictures(method, scene.train, device, run.path / SHEET, **keep)
    trainer = Trainer(
        method,
        choose_batches(method, batches),
        run,
        device=device,
        quiet=quiet,
        checkpoint_seconds=checkpoint_seconds,
        train_psnr=view_psnr(method, scene.train, device),
        watch=Live(pictures, board),
        snapshots=snapshots,
    )
    if not trainer.run():
        raise Interrupted
    export(method, run.path / "export")
    began = time.monotonic()
    refuse_empty(method, scene.train, device, run.path)
    found = assess(method, config, hull, scene, device=device, run_dir=run.path, quiet=quiet)
    eval_s = time.monotonic() - began
    if board is not None:
        board.scalars("test", found["test"], trainer.step)
    step_ms = 1000 * trainer.train_s / max(trainer.step, 1)
    run.record.pop("error", None)
    run.update(
        status="finished",
        timing={"hull_s": hull_s, "train_s": trainer.train_s, "eval_s": eval_s, "step_ms": step_ms},
        metrics=finite(found),
        model=summarise(method),
        events=events_of(method),
    )
    return trainer.resumed_from, method, hull


def choose_batches(method: Method, batches: Batches) -> Callable[[int], Batch]:
    """Whole views, or pixels for a method that says how many of them it wants."""
    pixels, view_at = (getattr(method, name, None) for name in ("pixels_per_step", "view_at"))
    if pixels is not None:
        return lambda step: batches.pixel_batch(step, pixels(step))
    if view_at is None:
        return batches.view_batch

    def chosen(step: int) -> Batch:
        view = view_at(step)
        return batches.view_batch(step) if view is None else batches.view(view)

    return chosen


def _warn_of_changes(before: Record, now: Record) -> None:
    lines = differences({k: before[k] for k in now if k in before}, {k: now[k] for k in now if k in before})
    if lines:
        log.warning(
            "the run goes on under other circumstances, its result may differ in the last digits: %s",
            "; ".join(lines),
        )


def build(
    preset: registry.Preset,
    config: Settings,
    views: Views,
    *,
    device: torch.device,
    seed: int,
    saved: Path | None = None,
) -> tuple[Method, Hull | None, float]:
    """The method set up on the training views, its hull (None without one), and the seconds that took.

    Method and hooks work in the frame of `move_near(views)`; the hull returned, and the cameras that the method is
    asked to render, are in the views' own.

    Args:
        saved: the folder in which the run keeps its hull, if it has one already: it is read, not carved again.
    """
    began = time.monotonic()
    with phase("carving the hull"):
        hull = find_hull(config, views, saved)
    hull_s = time.monotonic() - began
    near = move_near(views)
    near_hull = hull if hull is None or near is views else hull.relative_to(near.origin.numpy())
    method: Method = preset.load()(config)
    with phase("setting up the method"):
        method.setup(near, make_hooks(config, near_hull, near), hull=near_hull, device=device, seed=seed)
    if near is not views:
        method = LocalMethod(method, near.origin)
    return method, hull, hull_s


def make_hooks(config: Settings, hull: Hull | None, views: Views) -> list[Hook]:
    """The hook that the config's field `vd` asks for, in a list; none where it is off or not there.

    Raises:
        ConfigError: when it is asked for and there is no hull to go with it.
    """
    vd = getattr(config, "vd", None)
    if vd is None or not vd.enabled:
        return []
    if hull is None:
        raise ConfigError(
            "the visible-domain hook is asked for, but no hull to go with it",
            where="--method.vd.enabled",
            todo="start from the variant +vd, which has both",
        )
    return [vd.build(hull, views)]


def restore(
    preset: registry.Preset, config: Settings, views: Views, path: Path, *, device: torch.device, seed: int
) -> tuple[Method, Hull | None, int]:
    """The method in the state of a run directory's newest checkpoint, its hull, and that step.

    Raises:
        CheckpointError: when there is no checkpoint to read.
    """
    found = checkpoints.load_newest(Path(path) / "checkpoints")
    if found is None:
        raise CheckpointError(
            "the run has no checkpoint that can be read", where=path, todo="run visdom-train again"
        )
    method, hull, _ = build(preset, config, views, device=device, seed=seed, saved=Path(path) / "hull")
    method.load_state_dict(found.tensors)
    return method, hull, found.step


def assess(
    method: Method,
    config: Settings,
    hull: Hull | None,
    scene: Scene,
    *,
    device: torch.device,
    run_dir: Path,
    quiet: bool = False,
) -> Record:
    """Metrics and pictures of the test views, see `evaluate`; without any, `draw_training_views`.

    The reference hull is carved once per run and kept as hull/reference.npz, unless the method's own is the same.
    """
    views, folder = scene.test, run_dir / "renders"
    reference: Hull | None = None
    if not len(views):
        draw_training_views(method, scene.train, hull, device=device, folder=folder, quiet=quiet)
    elif hull is not None and getattr(config, "hull", None) == VisibleDomain():
        reference = hull
    elif (reference := read_hull(run_dir / "hull" / REFERENCE)) is None:
        log.info("carving the reference hull for the metrics, the same for every method")
        with phase("carving the reference hull"):
            reference = carve_reference(scene.train)
        if reference is not None:
            reference.save(run_dir / "hull" / REFERENCE)
    if len(views):
        size = f"{int(views.cameras.width[0])} x {int(views.cameras.height[0])}"
        s = "s" * (len(views) != 1)
        log.info("evaluation: %d test view%s of %s pixels, the size of training", len(views), s, size)
    with Progress(
        len(views), title="evaluation", unit="test view", quiet=quiet or not len(views)
    ) as progress:
        return evaluate(
            method, views, reference_hull=reference, device=device, folder=folder, progress=progress
        )


def evaluate_again(
    method: Method,
    config: Settings,
    hull: Hull | None,
    scene: Scene,
    *,
    device: torch.device,
    run_dir: Path,
    quiet: bool = False,
) -> Record:
    """Measures a restored method and puts the result into its run.json, which is returned.

    Raises:
        CheckpointError: when a process is training into the directory.
    """
    with RunDir.open_existing(run_dir) as run:
        began = time.monotonic()
        found = assess(method, config, hull, scene, device=device, run_dir=run.path, quiet=quiet)
        timing = run.record.get("timing", {}) | {"eval_s": time.monotonic() - began}
        run.update(metrics=finite(found), timing=timing)
        return run.record


def export(method: Method, folder: Path) -> list[Path]:
    """The method's own export, file by file in one step each."""
    import tempfile

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with tempfile.TemporaryDirectory(prefix=".part-", dir=folder.parent) as draft:
        made_all = method.export(Path(draft))
        if not isinstance(made_all, list):
            raise PluginError(
                f"export returned a {type(made_all).__name__}, not the list of the files that it wrote",
                where=f"{type(method).__module__}.{type(method).__qualname__}",
                todo="return [path, ...], each below the folder it was given",
            )
        for made in made_all:
            target = folder / Path(made).relative_to(draft)
            with appearing(target) as part:
                Path(made).replace(part)
            written.append(target)
    return written
