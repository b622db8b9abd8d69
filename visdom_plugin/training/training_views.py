"""Pictures of the training views, and of an orbit, for runs that have no test views to look at."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from visdom_plugin.errors import count_of
from visdom_plugin.figures.contact_sheet import (
    SHEET_ROWS,
    draw_sheet,
    shown_on_sheet,
    to_bytes,
    write_png,
)
from visdom_plugin.geometry.camera_paths import orbit
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Views
from visdom_plugin.training.evaluate import Renderer, draw_truth, render_on_white
from visdom_plugin.training.progress import Progress
from visdom_plugin.training.trainer import TrainingError

ORBIT_VIEWS = 4
LARGEST_PX = 800
"""Longer side of these pictures, at most."""
LOOKED_AT, OBJECT_PX = 16, 400
"""Training views whose opacity is looked at, and the pixels their object has then, at most."""
INVISIBLE = 1 / 255

log = logging.getLogger(__name__)


def refuse_empty(method: Renderer, views: Views, device: torch.device, where: Path) -> None:
    """Sees to it that the trained method draws something wherever the photograph has the object.

    At most 16 views are looked at, small.

    Raises:
        TrainingError: a training view is empty.
    """
    count = min(len(views), LOOKED_AT)
    for i in sorted({round(j * (len(views) - 1) / max(count - 1, 1)) for j in range(count)}):
        area = int(views.demanded(i).sum())
        if views.mask_origin(i) != "given" or not area:
            continue
        _, alpha = render_on_white(method, _shrunk(views.cameras[i], (OBJECT_PX / area) ** 0.5), device)
        if float(alpha.max()) < INVISIBLE:
            raise TrainingError(
                f"nothing is drawn in training view {views.names[i]}: the model is empty there",
                where=where,
                cause="a schedule of so few steps that nothing has appeared yet, an optimisation that removed the "
                "object, or a pose that looks past the others' object",
                todo="give more --method.steps if there were less than 200; else look at the data with "
                "visdom-check, and in log.jsonl where the loss went up; visdom-eval measures the run as it is",
            )


def draw_training_views(
    method: Renderer, views: Views, hull: Hull | None, *, device: torch.device, folder: Path, quiet: bool
) -> None:
    """`training_sheet.png`, a sheet of the training views, and `orbit_sheet.png`, views from four sides.

    Args:
        hull: the orbit's centre; by default it is what the cameras look at.
        folder: of the run's renders.
    """
    shown = shown_on_sheet(len(views))
    size = (int(views.cameras[0].width), int(views.cameras[0].height))
    log.info(
        "pictures: %s and %d of an orbit, at most %d pixels wide or high (photographs: %d x %d)",
        *(count_of(len(shown), "training view"), ORBIT_VIEWS, LARGEST_PX, *size),
    )
    centre = None if hull is None else torch.as_tensor(hull.centre)
    round_about = orbit(views.cameras, ORBIT_VIEWS, centre)
    cameras = [views.cameras[i] for i in shown] + [round_about[i] for i in range(ORBIT_VIEWS)]
    pictures = []
    with Progress(len(cameras), title="pictures", unit="picture", quiet=quiet) as progress:
        for i, camera in enumerate(cameras):
            rgb, alpha = render_on_white(method, _shrunk(camera, LARGEST_PX / max(size)), device)
            pictures.append([to_bytes(rgb), to_bytes(alpha[..., None].expand(-1, -1, 3))])
            progress.show(i + 1)
    known = [views.mask_origin(i) == "given" for i in shown]
    truth = [draw_truth(views, i, given) for i, given in zip(shown, known, strict=True)]
    rows = zip(shown, truth, pictures[: len(shown)], strict=True)
    columns = [(views.names[i], [photograph, *drawn]) for i, photograph, drawn in rows]
    write_png(folder / "training_sheet.png", draw_sheet(columns, SHEET_ROWS))
    turns = pictures[len(shown) :]
    columns = [(f"{360 * i // ORBIT_VIEWS} degrees", drawn) for i, drawn in enumerate(turns)]
    write_png(folder / "orbit_sheet.png", draw_sheet(columns, SHEET_ROWS[1:]))


def _shrunk(camera: Cameras, factor: float) -> Cameras:
    """A camera whose picture is smaller by a factor; never larger."""
    width, height = (max(1, round(int(x) * min(factor, 1.0))) for x in (camera.width, camera.height))
    return camera.resized(width, height)
