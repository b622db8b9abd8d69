"""Truth, render and error of one test view of a run, as small PNG files."""

from __future__ import annotations

import base64
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

ERROR_FULL = 0.5
"""Mean absolute difference over channels, of images in [0, 1], that the error picture's brightest colour shows."""


@dataclass(frozen=True)
class Strip:
    """Three PNG files of one view, of equal size."""

    view: str
    psnr: float | None
    truth: bytes
    render: bytes
    error: bytes


def read_strip(run_dir: Path, record: Mapping[str, Any], height_px: int) -> Strip | None:
    """The middle one of the views on a finished run's contact sheet; the same view for all runs on a scene.

    Args:
        record: run.json's content.
        height_px: pictures higher than this are made smaller.

    Returns:
        None where the run has no pictures, or they cannot be read.
    """
    try:
        return _read(Path(run_dir) / "renders", record, height_px)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        log.debug("no pictures of %s: %r", run_dir, error)
        return None


def data_uri(png: bytes) -> str:
    """A PNG file as the address of itself."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _read(folder: Path, record: Mapping[str, Any], height_px: int) -> Strip:
    import cv2

    from visdom_plugin.training.pictures import SHEET_ROWS, cut_sheet, picture_names, shown_on_sheet

    names = list(record["data"]["test"])
    shown = shown_on_sheet(len(names))
    column = len(shown) // 2
    name = names[shown[column]]
    size = _load(folder / "test" / f"{picture_names(names)[shown[column]]}.png").shape[:2]
    sheet = _load(folder / "test_sheet.png")
    truth, render = (cut_sheet(sheet, column, row, SHEET_ROWS, size) for row in (0, 1))
    scale = min(1.0, height_px / truth.shape[0])
    small = [max(1, round(n * scale)) for n in truth.shape[1::-1]]
    truth, render = (cv2.resize(p, small, interpolation=cv2.INTER_AREA) for p in (truth, render))
    difference = cv2.absdiff(truth, render).astype("float32").mean(axis=2)
    grey = (difference / ERROR_FULL).clip(0, 255).round().astype("uint8")
    error = cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)
    found = record.get("metrics", {}).get("per_view", {}).get(name, {}).get("psnr")
    return Strip(name, found, *(_encode(p) for p in (truth, render, error)))


def _load(path: Path):
    """(H, W, 3) uint8, in OpenCV's order of channels."""
    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"{path} is no picture")
    return picture


def _encode(picture) -> bytes:
    import cv2

    ok, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not ok:
        raise ValueError("OpenCV could not encode a picture")
    return data.tobytes()
