"""Draws what a report shows of one run, and keeps it in the run's folder report/: data.json and small pictures."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from visdom_plugin.atomic_files import write_bytes, write_json
from visdom_plugin.compute.waiting import counting
from visdom_plugin.figures.contact_sheet import colour_depth, draw_error, shown_on_sheet, to_bytes
from visdom_plugin.geometry.camera_paths import orbit, widen
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.seeding import generator
from visdom_plugin.training.evaluate import draw_truth, hull_silhouette

if TYPE_CHECKING:
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.render import Render
    from visdom_plugin.scene import Scene, Views
    from visdom_plugin.training.evaluate import Renderer

FOLDER, DATA = "report", "data.json"
SHOWN, INPUTS = 4, 12
"""Views with all their pictures, and training views shown small, at most."""
_WIDTH, _SMALL, _ORBIT = 480, 240, 240
_FRAMES = 24
_SEEN = 1000
"""Points of the hull that pictures from all round show."""
_SECONDS = 10.0
"""What the orbit may take: where it would take longer, its pictures are smaller."""
_MASK, _HULL = (255, 170, 0), (0, 170, 230)


@dataclass(frozen=True)
class Finished:
    """A run that is to be reported on."""

    record: dict[str, Any]
    renderer: Renderer
    scene: Scene
    hull: Hull | None
    device: torch.device
    path: Path
    command: str = ""
    """The command that repeats it."""
    findings: list[dict[str, Any]] = field(default_factory=list)
    """What the check says of the data: kind, what, views, sure, todo."""


def state_of(record: dict[str, Any]) -> dict[str, Any]:
    """What a report's pictures depend on: they are drawn again when it changes."""
    return {"metrics": record.get("metrics", {}).get("test"), "timing": record.get("timing")}


def gather(run: Finished) -> Path:
    """Draws everything anew; returns data.json."""
    folder = run.path / FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    began = time.monotonic()
    views, kind = (run.scene.test, "test") if len(run.scene.test) else (run.scene.train, "training")
    shown = shown_on_sheet(len(views))[:SHOWN]
    pixels, drawn = 0, []
    with counting("drawing views for the report", len(shown)) as count:
        for n, i in enumerate(shown):
            camera = _narrow(views.cameras[i], _WIDTH)
            render = _draw(run, camera)
            pixels += int(camera.width) * int(camera.height)
            drawn.append(count(_keep_view(folder, n, views, i, render)))
    rate = max(time.monotonic() - began, 1e-6) / max(pixels, 1)
    data = {
        "state": state_of(run.record),
        "command": run.command,
        "findings": run.findings,
        "kind": kind,
        "views": drawn,
        "orbit": _keep_orbit(folder, run, rate),
        "inputs": _keep_inputs(folder, run),
        "hull": None if run.hull is None else _describe_hull(run.hull),
        "points": dict(zip(("gaussians",), _count(run.renderer), strict=False)),
    }
    write_json(folder / DATA, data)
    return folder / DATA


def _draw(run: Finished, camera: Cameras) -> Render:
    with torch.no_grad():
        return run.renderer.render(camera.to(run.device), torch.ones(3, device=run.device))


def _narrow(camera: Cameras, width: int) -> Cameras:
    """The camera with pictures of at most this width."""
    if int(camera.width) <= width:
        return camera
    return camera.resized(width, max(1, round(int(camera.height) * width / int(camera.width))))


def _keep_view(folder: Path, n: int, views: Views, i: int, render: Render) -> dict[str, Any]:
    measured = views.mask_origin(i) == "given"
    size = render.alpha.shape[1], render.alpha.shape[0]
    truth = _resize(draw_truth(views, i, measured), size)
    rgb = to_bytes(render.rgb.detach().cpu())
    alpha = render.alpha.detach().float().cpu().numpy()
    ignored = views.ignored(i)
    # Where nothing is known there is no error.
    known = (
        True if ignored is None else ~_resize(ignored.numpy().astype(np.uint8), size).astype(bool)[..., None]
    )
    pictures = {
        "truth": truth,
        "render": rgb,
        "error": draw_error(truth, np.where(known, rgb, truth)),
        "depth": colour_depth(render.depth.detach().float().cpu().numpy(), alpha),
        "opacity": np.repeat((alpha.clip(0, 1) * 255).round().astype(np.uint8)[..., None], 3, 2),
    }
    files = {what: _write(folder, f"view_{n}_{what}", picture) for what, picture in pictures.items()}
    return {"name": str(views.names[i]), "width": size[0], "height": size[1], "files": files}


def _keep_orbit(folder: Path, run: Finished, rate: float) -> dict[str, Any]:
    """Pictures on a circle round the object, side by side in one file."""
    cameras = run.scene.train.cameras
    aspect = int(cameras.height[0]) / int(cameras.width[0])
    affordable = int((_SECONDS / rate / _FRAMES / aspect) ** 0.5)
    width = max(96, min(_ORBIT, affordable))
    height = max(1, round(width * aspect))
    centre = look_at_point(cameras) if run.hull is None else torch.as_tensor(run.hull.centre)
    circle = orbit(cameras, _FRAMES, centre)
    if run.hull is not None:
        circle = widen(circle, run.hull.sample_points(_SEEN, generator(0, "orbit")))
    with counting("drawing an orbit for the report", _FRAMES) as count:
        frames = [
            count(to_bytes(_draw(run, circle[i].resized(width, height)).rgb.detach().cpu()))
            for i in range(_FRAMES)
        ]
    file = _write(folder, "orbit", np.concatenate(frames, 1))
    return {"file": file, "frames": _FRAMES, "width": width, "height": height}


def _keep_inputs(folder: Path, run: Finished) -> list[dict[str, Any]]:
    """Training views with the outlines of mask and hull, and what the hull covers of each mask."""
    import cv2

    views, rows = run.scene.train, []
    for i in range(len(views)):
        mask = np.asarray(views.masks[i])
        row: dict[str, Any] = {"name": str(views.names[i]), "mask": float(mask.mean())}
        seen = None if run.hull is None else hull_silhouette(run.hull, views.cameras[i]).numpy()
        if seen is not None:
            row["covered"] = float((seen & mask).sum() / max(mask.sum(), 1))
            row["on_mask"] = float((seen & mask).sum() / max(seen.sum(), 1))
        if i < INPUTS:
            height = max(1, round(mask.shape[0] * _SMALL / mask.shape[1]))
            picture = np.ascontiguousarray(_resize(np.asarray(views.images[i]), (_SMALL, height)))
            for outline, colour in ((seen, _HULL), (mask, _MASK)):
                if outline is not None:
                    small = cv2.resize(
                        outline.astype(np.uint8), (_SMALL, height), interpolation=cv2.INTER_AREA
                    )
                    lines, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
                    cv2.drawContours(picture, lines, -1, colour, 1, cv2.LINE_AA)
            row["file"] = _write(folder, f"input_{i}", picture)
        rows.append(row)
    return rows


def _describe_hull(hull: Hull) -> dict[str, Any]:
    return {
        "kind": hull.summary.get("kind"),
        "k": hull.summary.get("k"),
        "voxels": hull.voxels,
        "shape": list(hull.shape),
        "volume": hull.volume,
        "size": np.ptp(hull.extent, axis=0).tolist(),
        "inner": None if hull.inner is None else hull.inner.voxels / max(hull.voxels, 1),
    }


def _count(renderer: Any) -> tuple[int, ...]:
    splats = getattr(renderer, "splats", None)
    return () if splats is None else (len(splats),)


def _resize(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    way = cv2.INTER_AREA if picture.shape[1] > size[0] else cv2.INTER_LINEAR
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=way)


def _write(folder: Path, name: str, picture: np.ndarray) -> str:
    import cv2

    ok, data = cv2.imencode(".webp", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_WEBP_QUALITY, 88])
    if not ok:
        raise OSError(f"OpenCV could not encode {name}")
    write_bytes(folder / f"{name}.webp", data.tobytes())
    return f"{name}.webp"
