"""Pictures behind the browser's scene: a run as it renders, two runs side by side, the error of a photograph."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from visdom_plugin.figures.contact_sheet import draw_error, to_bytes
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.training.evaluate import draw_truth
from visdom_plugin.viewer.shown import Subject, camera_from, nearest_view

SIDE_BY_SIDE, UNDER_SLIDER = "side by side", "under a slider"
COMPARISONS = (SIDE_BY_SIDE, UNDER_SLIDER, "one at a time")
_EDGE = (224, 33, 138)


class Look(NamedTuple):
    """What is asked for."""

    chosen: int = 0
    """Number of the run."""
    comparison: str = COMPARISONS[-1]
    share: float = 0.5
    """Of the picture, for the first run under the slider."""
    shade: float = 1.0
    """Grey of the background, 0 black."""
    error: bool = False
    """How far the run is from the nearest photograph, in place of the run."""


def draw(
    subject: Subject, view: Any, width: int, middle: np.ndarray, look: Look
) -> tuple[np.ndarray, str | None]:
    """(H, W, 3) uint8, and what there is to say of it.

    Args:
        view: wxyz, position, fov and aspect of a browser's camera.
        width: of the picture; its height follows from the aspect.
        middle: (3,) of the browser's frame in the capture's.
    """
    size = width, max(1, round(width / float(view.aspect)))

    def camera_of(size: tuple[int, int]) -> Cameras:
        return camera_from(view.wxyz, view.position, float(view.fov), size, middle)

    def render(number: int, size: tuple[int, int]) -> np.ndarray:
        return render_run(subject, number, camera_of(size), look.shade)

    if look.error:
        return _draw_error(subject, look.chosen, camera_of(size))
    if look.comparison == SIDE_BY_SIDE:
        # Both from the same place, at the same scale; each has half of the width.
        half = max(1, width // 2)
        picture = np.concatenate([render(n, (half, size[1])) for n in range(2)], 1)
        picture[:, half - 1 : half + 1] = _EDGE
        return picture, None
    if look.comparison == UNDER_SLIDER:
        edge = min(round(look.share * width), width - 1)
        picture = np.concatenate([render(0, size)[:, :edge], render(1, size)[:, edge:]], 1)
        picture[:, edge] = _EDGE
        return picture, None
    return render(look.chosen, size), None


def render_run(subject: Subject, number: int, camera: Cameras, shade: float) -> np.ndarray:
    """(H, W, 3) uint8 of a run on grey."""
    run = subject.runs[number]
    with torch.no_grad():
        render = run.renderer.render(camera.to(run.device), torch.full((3,), shade, device=run.device))
    return to_bytes(render.rgb.detach().cpu())


def _draw_error(subject: Subject, number: int, camera: Cameras) -> tuple[np.ndarray, str]:
    """Error against the photograph nearest to a camera, from where that was taken, as large as it fits."""
    import cv2

    views = subject.scene.train
    i = nearest_view(views.cameras, camera)
    own, (width, height) = views.cameras[i], camera.size
    scale = min(width / int(own.width), height / int(own.height))
    size = [max(1, round(scale * int(side))) for side in (own.width, own.height)]
    render = render_run(subject, number, own.resized(*size), 1.0)
    truth = cv2.resize(
        draw_truth(views, i, views.mask_origin(i) == "given"), size, interpolation=cv2.INTER_AREA
    )
    picture = np.full((height, width, 3), 48, np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    picture[top : top + size[1], left : left + size[0]] = draw_error(truth, render)
    return picture, f"error against {views.names[i]}"
