"""Truth, render and error of one test view of a run, as small PNG files."""

from __future__ import annotations

import base64
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

ERROR_FULL = 0.5
"""The difference that the brightest colour of `draw_error` stands for, of images in [0, 1]."""


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
    import cv2

    try:
        folder, names = Path(run_dir) / "renders", tuple(record["data"]["test"])
        written = (folder / "test_sheet.png").stat().st_mtime_ns
        name, *files = _read(folder, names, height_px, written)
        found = record.get("metrics", {}).get("per_view", {}).get(name, {}).get("psnr")
        return Strip(name, found, *files)
    except (OSError, ValueError, KeyError, TypeError, IndexError, cv2.error) as error:
        log.debug("no pictures of %s: %r", run_dir, error)
        return None


def data_uri(png: bytes) -> str:
    """A PNG file as the address of itself."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


@lru_cache(maxsize=1024)
def _read(
    folder: Path, names: tuple[str, ...], height_px: int, written: int
) -> tuple[str, bytes, bytes, bytes]:
    """The view's name and three PNG files. A driver writes its table many times: `written` is the sheet's age."""
    import cv2

    from visdom_plugin.figures import contact_sheet

    shown = contact_sheet.shown_on_sheet(len(names))
    column = len(shown) // 2
    file = contact_sheet.picture_names(names)[shown[column]]
    size = contact_sheet.read_png(folder / "test" / f"{file}.png").shape[:2]
    sheet = contact_sheet.read_png(folder / "test_sheet.png")
    truth, render = (
        contact_sheet.cut_sheet(sheet, column, r, contact_sheet.SHEET_ROWS, size) for r in (0, 1)
    )
    scale = min(1.0, height_px / truth.shape[0])
    small = [max(1, round(n * scale)) for n in truth.shape[1::-1]]
    truth, render = (cv2.resize(p, small, interpolation=cv2.INTER_AREA) for p in (truth, render))
    error = contact_sheet.draw_error(truth, render)
    return names[shown[column]], _encode(truth), _encode(render), _encode(error)


def _encode(picture: np.ndarray) -> bytes:
    import cv2

    ok, data = cv2.imencode(".png", picture[..., ::-1])
    if not ok:
        raise ValueError("OpenCV could not encode a picture")
    return data.tobytes()
