"""Renders the test views, measures them and draws the picture to look at first."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import EmptyHullError
from visdom_plugin.figures.contact_sheet import (
    SHEET_ROWS,
    draw_sheet,
    picture_names,
    shown_on_sheet,
    to_bytes,
    write_png,
)
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.render import Render
from visdom_plugin.scene import Views
from visdom_plugin.training import metrics
from visdom_plugin.training.progress import Progress
from visdom_plugin.training.protocols import Method

log = logging.getLogger(__name__)


def evaluate(
    method: Method,
    views: Views,
    *,
    reference_hull: Hull | None,
    device: torch.device,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measures every view and, with a folder, writes its render and the contact sheet.

    A view whose mask is not its own has no truth on white: it is rendered, its metrics are NaN, it takes no part
    in the means, and its row says `mask_origin`.

    Args:
        method: trained.
        views: the test views.
        reference_hull: the default visible domain of the training views, for `outside_hull_mass`; None
            leaves that metric undefined.
        device: where the method renders.
        folder: `<folder>/test/<name>.png` and `<folder>/test_sheet.png` are written; other pictures in
            `<folder>/test` are removed.
        progress: entered; told of each view that is done.

    Returns:
        {"test": means, "per_view": {name: metrics}, "measured_views": how many the means are of, "protocol":
        metrics.PROTOCOL}; see `metrics.compare`.
    """
    perceptual = metrics.load_lpips()
    rows: dict[str, Mapping[str, object]] = {}
    measured_rows: list[dict[str, float]] = []
    columns = []
    shown = shown_on_sheet(len(views))
    files = picture_names(views.names)
    for i, name in enumerate(views.names):
        rgb, alpha = render_on_white(method, views.cameras[i], device)
        measured = views.mask_origin(i) == "given"
        if measured:
            seen = None if reference_hull is None else hull_silhouette(reference_hull, views.cameras[i])
            image, mask, ignore = views.images[i], views.masks[i], views.ignored(i)
            measured_rows.append(
                metrics.compare(
                    rgb, alpha, image, mask, hull_silhouette=seen, perceptual=perceptual, ignore=ignore
                )
            )
            rows[name] = measured_rows[-1]
        else:
            rows[name] = {**dict.fromkeys(metrics.NAMES, math.nan), "mask_origin": views.mask_origin(i)}
        if folder is not None:
            write_png(folder / "test" / f"{files[i]}.png", to_bytes(rgb))
            if i in shown:
                title = f"{name}  " + (f"{rows[name]['psnr']:.1f} dB" if measured else "no mask")
                grey = to_bytes(alpha[..., None].expand(-1, -1, 3))
                columns.append((title, [draw_truth(views, i, measured), to_bytes(rgb), grey]))
        if progress is not None:
            progress.show(i + 1)
    if folder is not None:
        _remove_others(folder / "test", files)
        if columns:
            write_png(folder / "test_sheet.png", draw_sheet(columns, SHEET_ROWS))
    return {
        "test": metrics.mean_over_views(measured_rows),
        "per_view": rows,
        "measured_views": len(measured_rows),
        "protocol": dict(metrics.PROTOCOL),
    }


def draw_truth(views: Views, i: int, measured: bool) -> np.ndarray:
    """The photograph as bytes, on white where a mask tells what is the object; ignored pixels are white."""
    image, ignore = views.images[i], views.ignored(i)
    truth = metrics.whiten(image, views.masks[i]) if measured else image.double() / 255
    return to_bytes(truth if ignore is None else truth.masked_fill(ignore[..., None], 1.0))


def _remove_others(folder: Path, names: Sequence[str]) -> None:
    """Removes pictures that an evaluation of other views left behind."""
    for path in folder.glob("*.png"):
        if path.stem not in names:
            path.unlink()


class Renderer(Protocol):
    """Anything that draws what a camera sees: a trained method, or Gaussians from a file."""

    def render(self, camera: Cameras, background: Tensor) -> Render:
        """One view on a background colour (3,); both are on the same device."""
        ...


def render_on_white(method: Renderer, camera: Cameras, device: torch.device) -> tuple[Tensor, Tensor]:
    """One view on white, on the CPU: rgb (H, W, 3) unclamped and alpha (H, W)."""
    with torch.no_grad():
        render = method.render(camera.to(device), torch.ones(3, device=device))
    return render.rgb.detach().cpu(), render.alpha.detach().cpu()


def carve_reference(views: Views, domain: VisibleDomain | None = None) -> Hull | None:
    """The hull that `outside_hull_mass` is measured against: the default visible domain of these views.

    The same for every method and variant. None, with a warning, when it is empty, and when no view has a mask.
    """
    if not views.has_masks:
        return None
    try:
        return (domain or VisibleDomain()).carve(*views.silhouettes())
    except EmptyHullError as error:
        log.warning("outside_hull_mass is left out: the reference hull is empty\n  %s", error.what)
        return None


def hull_silhouette(hull: Hull, camera: Cameras) -> Tensor:
    """(H, W) bool, True where a pixel's ray meets the hull."""
    from visdom_plugin.hull.queries.raycast import depth_and_silhouette

    return torch.as_tensor(depth_and_silhouette(hull, camera)[1]).cpu()
