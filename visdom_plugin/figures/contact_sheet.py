"""Renders as files: PNGs, the contact sheet, error and depth in colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from visdom_plugin.atomic_files import write_bytes

if TYPE_CHECKING:
    from torch import Tensor

SHEET_WIDTH_PX = 260
"""Width of one picture on the contact sheet."""
SHEET_VIEWS = 6
"""Views on the contact sheet, at most."""
SHEET_ROWS = ("truth", "render", "opacity")
_SHEET_TOP, _SHEET_GAP = 24, 4
_SUFFIXES = ("png", "jpg", "jpeg", "tif", "tiff", "webp", "bmp")


def picture_names(names: Sequence[str]) -> list[str]:
    """Views' names as file names without suffix: folders become part of the name; all stay different."""
    flat = [name.replace("\\", "/").strip("/").replace("/", "_") for name in names]
    stems = [n.rpartition(".")[0] if n.rpartition(".")[2].lower() in _SUFFIXES else n for n in flat]
    for candidates in (stems, flat):
        if all(candidates) and len(set(candidates)) == len(names):
            return candidates
    return [f"{i:03d}_{name}" for i, name in enumerate(flat)]


def to_bytes(image: Tensor) -> np.ndarray:
    """(H, W, 3) in [0, 1] to uint8, clamped and rounded."""
    from visdom_plugin.render import quantise

    return (quantise(image) * 255).round().byte().numpy()


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) grey, uint8, in one step."""
    import cv2

    if image.ndim == 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    ok, data = cv2.imencode(".png", np.ascontiguousarray(image))
    if not ok:
        raise OSError(f"OpenCV could not encode {path}")
    write_bytes(path, data.tobytes())


def shown_on_sheet(count: int) -> list[int]:
    """Positions of the views that the contact sheet shows, of `count` views, in its order from left to right."""
    return sorted(set(np.linspace(0, count - 1, min(SHEET_VIEWS, count)).round().astype(int).tolist()))


def draw_sheet(columns: list[tuple[str, list[np.ndarray]]], rows: Sequence[str]) -> np.ndarray:
    """A labelled table of pictures, (H, W, 3) uint8.

    Args:
        columns: title and one picture (h, w, 3) uint8 per row; sizes may differ.
        rows: names of the rows.
    """
    import cv2

    from visdom_plugin.figures.canvas import Canvas

    margin, top, gap = _sheet_margin(rows), _SHEET_TOP, _SHEET_GAP
    cells = []
    for _, pictures in columns:
        h, w = pictures[0].shape[:2]
        size = (SHEET_WIDTH_PX, _sheet_height(h, w))
        way = cv2.INTER_AREA if w > SHEET_WIDTH_PX else cv2.INTER_NEAREST
        cells.append([cv2.resize(p, size, interpolation=way) for p in pictures])
    row_height = max(p.shape[0] for column in cells for p in column)
    width = margin + len(columns) * (SHEET_WIDTH_PX + gap)
    sheet = Canvas(top + len(rows) * (row_height + gap), width, 224)
    for r, label in enumerate(rows):
        sheet.write(label, 6, top + r * (row_height + gap) + row_height // 2, width=margin - 8)
    for c, (title, _) in enumerate(columns):
        x = margin + c * (SHEET_WIDTH_PX + gap)
        sheet.write(title, x + 2, 16, width=SHEET_WIDTH_PX - 4)
        for r, picture in enumerate(cells[c]):
            sheet.paste(picture, x, top + r * (row_height + gap))
    return sheet.draw()


def cut_sheet(
    sheet: np.ndarray, column: int, row: int, rows: Sequence[str], size: tuple[int, int]
) -> np.ndarray:
    """One picture of a contact sheet as it is there, (h, SHEET_WIDTH_PX, 3) uint8; the inverse of `draw_sheet`.

    Args:
        rows: names of the sheet's rows.
        size: (height, width) of the picture before it was put there.
    """
    pitch = (sheet.shape[0] - _SHEET_TOP) // len(rows)
    x, y = _sheet_margin(rows) + column * (SHEET_WIDTH_PX + _SHEET_GAP), _SHEET_TOP + row * pitch
    return sheet[y : y + _sheet_height(*size), x : x + SHEET_WIDTH_PX]


def _sheet_margin(rows: Sequence[str]) -> int:
    return max(62, 14 + 8 * max(map(len, rows)))


def _sheet_height(height: int, width: int) -> int:
    return max(1, round(height * SHEET_WIDTH_PX / width))


def draw_error(truth: np.ndarray, render: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: mean absolute difference over channels, black for none, brightest from half the range."""
    import cv2

    difference = cv2.absdiff(truth, render).astype(np.float32).mean(axis=2)
    grey = (2 * difference).clip(0, 255).round().astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1])


def depth_span(depth: np.ndarray, alpha: np.ndarray) -> tuple[float, float] | None:
    """Range of depths of what is half opaque, without a hundredth at either end; None where nothing is."""
    there = depth[alpha > 0.5]
    return (float(np.percentile(there, 1)), float(np.percentile(there, 99))) if len(there) else None


def colour_depth(depth: np.ndarray, alpha: np.ndarray, span: tuple[float, float] | None = None) -> np.ndarray:
    """(H, W, 3) uint8: near is bright, far is dark; white beside what is half opaque.

    Args:
        depth, alpha: (H, W).
        span: depths of the brightest and the darkest colour; by default this picture's own.
    """
    import cv2

    near, far = span or depth_span(depth, alpha) or (0.0, 1.0)
    share = ((far - depth) / max(far - near, 1e-9)).clip(0, 1)
    grey = (share * 255).round().astype(np.uint8)
    colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where((alpha > 0.5)[..., None], colours, 255).astype(np.uint8)


def read_png(path: Path) -> np.ndarray:
    """What `write_png` wrote of a colour picture, (H, W, 3) uint8 RGB."""
    import cv2

    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise OSError(f"{path} is no picture")
    return np.ascontiguousarray(picture[..., ::-1])
