"""Runs: a method trained on a scene, its pictures and its measures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from visdom_plugin import registry
from visdom_plugin.cli.commands.check import find_briefly, warn_of_faults
from visdom_plugin.cli.commands.render import cameras_along
from visdom_plugin.cli.options import Common, choose_budget, resolve_device
from visdom_plugin.cli.output.reports import report_finished
from visdom_plugin.cli.runs import default_run_dir, load_again, refuse_large_k, refuse_other_scene
from visdom_plugin.cli.scenes import make_data_manager
from visdom_plugin.errors import ConfigError
from visdom_plugin.figures.contact_sheet import to_bytes, write_png
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.render import Render
from visdom_plugin.scene import Scene
from visdom_plugin.training import run as training
from visdom_plugin.training.protocols import Method
from visdom_plugin.training.runs.config_io import from_plain
from visdom_plugin.training.runs.run_directory import Record, read_record
from visdom_plugin.workflow.wording import for_callers

BRIGHT = 4.0
"""Renders may exceed 1, by harmonics; no picture in [0, 1] reaches this."""


@dataclass(frozen=True)
class Run:
    """A run directory with the scene it was trained on. The method is read from its newest checkpoint when it is
    first needed."""

    path: Path
    """The run directory: pictures in `renders/`, splat or mesh in `export/`, and `report.html`."""
    scene: Scene
    device: torch.device
    """Where it renders."""

    @property
    def record(self) -> Record:
        """run.json's content: method, settings, data, metrics, timing."""
        return read_record(self.path)

    @property
    def metrics(self) -> dict[str, float]:
        """Means over the test views as measured last, by name: psnr, ssim, silhouette_iou and so on. Empty where
        nothing has been measured."""
        means: dict[str, float | None] = self.record.get("metrics", {}).get("test", {})
        return {name: value for name, value in means.items() if value is not None}

    @property
    def config(self) -> Any:
        """The method's settings, its own config dataclass."""
        record = self.record
        return from_plain(registry.find(record["method"]).full, record["config"], str(self.path / "run.json"))

    @property
    def hull(self) -> Hull | None:
        """The hull of its training; None for a variant without one."""
        return self._restored[1]

    @property
    def method(self) -> Method:
        """The trained method."""
        return self._restored[0]

    @property
    def step(self) -> int:
        """Steps that the checkpoint was trained for."""
        return self._restored[2]

    @cached_property
    def _restored(self) -> tuple[Method, Hull | None, int]:
        record, config = self.record, self.config
        preset = registry.find(record["method"])
        views = training.add_points(self.scene, preset, getattr(config, "hull", None)).train
        with torch.enable_grad():  # methods take a step for warming up, whatever the caller is doing
            return training.restore(preset, config, views, self.path, device=self.device, seed=record["seed"])

    @for_callers
    def render(self, camera: Cameras, background: tuple[float, float, float] = (1, 1, 1)) -> Render:
        """What one camera sees, on the CPU: colours, opacity and depth.

        Args:
            camera: one camera, such as `scene.test.cameras[0]`, in the scene's frame.
            background: colour behind the object, in [0, 1].

        Raises:
            ConfigError: `camera` holds several cameras.
            CheckpointError: the run has no checkpoint.
        """
        if camera.shape:
            shape = tuple(camera.shape)
            raise ConfigError(
                f"render takes one camera, and was given {shape[0] if len(shape) == 1 else shape}",
                todo="take one, cameras[0], or loop: for camera in cameras",
            )
        behind = torch.tensor(background, dtype=torch.float32, device=self.device)
        with torch.no_grad():
            drawn = self.method.render(camera.to(self.device), behind)
        rgb, alpha, depth = (x.detach().cpu() for x in (drawn.rgb, drawn.alpha, drawn.depth))
        return Render(rgb, alpha, depth)

    @for_callers
    def orbit(self, frames: int = 60) -> Cameras:
        """(frames,) cameras on a circle round the object, as `visdom-render --path orbit` has them."""
        if frames < 1:
            raise ConfigError(f"frames is {frames}", todo="give 1 or more")
        return cameras_along("orbit", frames, self.scene, self.hull)[0]

    @for_callers
    def evaluate(self, *, quiet: bool = True) -> dict[str, float]:
        """Renders and measures the test views again; `metrics`, and run.json, pictures and sheet are new.

        Raises:
            CheckpointError: the run has no checkpoint, or a process is training into it.
        """
        training.evaluate_again(
            self.method,
            self.config,
            self.hull,
            self.scene,
            device=self.device,
            run_dir=self.path,
            quiet=quiet,
        )
        return self.metrics


@for_callers
def train(
    method: str,
    scene: Scene,
    *,
    out: str | Path | None = None,
    budget: str = "auto",
    device: str = "auto",
    seed: int = 0,
    overwrite: bool = False,
    report: bool = True,
    quiet: bool = False,
    **settings: Any,
) -> Run:
    """Trains a method on a scene and measures it, as visdom-train does; resumes, or finds finished, the same run.

    Args:
        method: as after `method:`, e.g. "3dgs-go+vd"; `visdom-methods` lists them.
        scene: from `load`, or made of your own Views.
        out: run directory; None is runs/<scene>/<views>/<method>/<seed>.
        budget: "quick", "standard" or "full"; "auto" is quick on the CPU, full on CUDA.
        device: "cpu", "cuda" or "auto".
        overwrite: discard another run in the run directory.
        report: end with report.html.
        quiet: show no progress.
        settings: of the method, as `visdom-train method:NAME --show-config` lists them; a group as a dict,
            e.g. steps=500, hull={"k": 2}.

    Raises:
        ConfigError: an unknown method or setting; the valid ones are listed.
        SceneError: the scene cannot be trained on, masks certainly inverted among it.
        CheckpointError: the run directory holds another run.
        EmptyHullError: nothing is left of the hull.
    """
    preset = registry.find(method.removeprefix("method:"))
    if not isinstance(scene, Scene):
        raise ConfigError(
            f"train takes a scene, and was given {scene!r:.60}",
            todo='open it first: train(method, load("DIR")); of Views of your own make a Scene',
        )
    asked = from_plain(Common(), {"budget": budget, "device": device, "seed": seed}, "train")
    found = resolve_device(asked.device)
    chosen, _ = choose_budget(asked.budget, found)
    config = from_plain(preset.settings(chosen), settings, f"settings of {preset.name}")
    path = Path(out) if out is not None else default_run_dir(scene.name, len(scene.train), preset.name, seed)
    refuse_large_k(config, scene)
    warn_of_faults(scene, inverted=bool(scene.source.get("invert_masks")))
    finish = partial(report_finished, scene=scene, run_dir=path, device=found, check=find_briefly)
    training.train(
        preset.name,
        config,
        scene,
        data_manager=make_data_manager,
        run_dir=path,
        device=found,
        seed=seed,
        quiet=quiet,
        overwrite=overwrite,
        budget=chosen,
        on_finished=finish if report else None,
    )
    return Run(path, scene, torch.device(found))


@for_callers
def open_run(
    path: str | Path, *, data: str | Path | None = None, scene: Scene | None = None, device: str = "auto"
) -> Run:
    """A run that `train` or visdom-train left on disk, with its scene.

    Args:
        path: the run directory.
        data: where the scene's folder lies now, when it has moved.
        scene: the scene itself, for a run that was trained on Views of your own.

    Raises:
        CheckpointError: `path` is no run directory, or the scene is not the one it was trained on.
        SceneError: the scene cannot be read.
    """
    path = Path(path)
    record = read_record(path)
    if scene is None:
        scene = load_again(record, path, None if data is None else Path(data))
    else:
        refuse_other_scene(scene, record, path, "the scene given")
    return Run(path, scene, torch.device(resolve_device(device)))


@for_callers
def save_image(path: str | Path, picture: Render | Tensor) -> Path:
    """Writes a picture as PNG.

    Args:
        path: ends in .png.
        picture: a Render, or a tensor (H, W, 3) or (H, W) in [0, 1], or uint8 or bool.

    Returns:
        The path.

    Raises:
        ConfigError: another ending, another shape, or numbers that are no brightness in [0, 1].
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"save_image writes PNG, not {path.name!r}", todo="end the name in .png")
    image = picture.rgb if isinstance(picture, Render) else torch.as_tensor(picture)
    if image.dim() not in (2, 3) or (image.dim() == 3 and image.shape[-1] != 3) or not image.numel():
        raise ConfigError(
            f"the picture has the shape {tuple(image.shape)}",
            todo="give (H, W, 3) or (H, W); of (3, H, W) make picture.permute(1, 2, 0)",
        )
    if image.dtype == torch.uint8:
        image = image / 255
    image = image.detach().cpu().float()
    if not image.abs().max() <= BRIGHT:  # NaN, too
        raise ConfigError(
            f"the picture's numbers reach {float(image.abs().max()):.4g}",
            cause="they are 0 to 255 and not in [0, 1], or depths, or not finite",
            todo="divide by the largest that they can be",
        )
    write_png(path, to_bytes(image if image.dim() == 3 else image[..., None].expand(-1, -1, 3)))
    return path
