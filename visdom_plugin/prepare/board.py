"""The printed ChArUco board: drawn as PDF at true size, found in photographs.

The board's frame, which becomes the scene's: origin in the board's middle, x along its short side, y along its
long side, z up from the paper, in metres.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from visdom_plugin.atomic_files import appearing
from visdom_plugin.errors import ConfigError, unknown_name
from visdom_plugin.prepare.settings import BoardSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0), "tabloid": (279.4, 431.8)}
"""Width and height in millimetres."""
_UNPRINTABLE_MM = 6.0
_RULER_MM = 100
_FOOT_MM = 15.0
"""Room below the board for the ruler and a line of text."""
_MM_PER_INCH = 25.4
_LIKELY = ("4X4_50", "5X5_50", "6X6_50", "7X7_50", "5X5_100", "6X6_250", "5X5_1000", "ARUCO_ORIGINAL",
           "APRILTAG_36H11")  # fmt: skip
"""Dictionaries that are tried where the board's own finds nothing."""
LEAST_CORNERS = 6
_WINDOW, _MOST_WINDOW = 0.2, 12
"""Half a corner's window, in distances to the nearest other corner, and in pixels at most."""


class Corners(NamedTuple):
    """Corners of the board that were found in one photograph."""

    ids: np.ndarray
    """(M,) int64 positions among `corner_points`."""
    uv: np.ndarray
    """(M, 2) float64 pixels, origin at the image's corner."""
    markers: int
    """Markers that were read."""


@lru_cache
def make_board(settings: BoardSettings) -> Any:
    """OpenCV's board; lengths in metres."""
    import cv2

    settings.check()
    dictionary = cv2.aruco.getPredefinedDictionary(_dictionary(settings.dictionary))
    needed = settings.squares[0] * settings.squares[1] // 2
    if needed > len(dictionary.bytesList):
        raise ConfigError(
            f"a board of {settings.squares[0]} x {settings.squares[1]} squares needs {needed} markers, and the "
            f"dictionary {settings.dictionary} has {len(dictionary.bytesList)}",
            where="--dictionary",
            todo="use a larger one, such as 4X4_250",
        )
    edges = settings.square_mm / 1000, settings.marker_mm / 1000
    board = cv2.aruco.CharucoBoard(settings.squares, *edges, dictionary)
    if settings.legacy:
        board.setLegacyPattern(True)
    return board


def corner_points(settings: BoardSettings) -> np.ndarray:
    """(C, 3) float64 inner corners in the board's frame."""
    width, height = settings.size_m
    points = np.asarray(make_board(settings).getChessboardCorners(), np.float64).reshape(-1, 3)
    # OpenCV's origin is the upper left corner, its y runs down the board.
    return np.stack([points[:, 0] - width / 2, height / 2 - points[:, 1], np.zeros(len(points))], -1)


def find_corners(grey: np.ndarray, settings: BoardSettings) -> Corners:
    """The board's corners in a photograph (H, W) uint8; none where there is no board."""
    import cv2

    detector = cv2.aruco.CharucoDetector(make_board(settings))
    uv, ids, _, markers = detector.detectBoard(grey)
    count = 0 if markers is None else len(markers)
    if ids is None or uv is None or len(ids) == 0:
        return Corners(np.zeros(0, np.int64), np.zeros((0, 2)), count)
    # OpenCV 5 has (M, 2) and OpenCV 4 (M, 1, 2); its origin is the first pixel's centre.
    fine = _refine(grey, np.asarray(uv, np.float32).reshape(-1, 2))
    return Corners(np.asarray(ids, np.int64).reshape(-1), fine + 0.5, count)


def _refine(grey: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(M, 2) float64 corners between pixels, each found in a window that no other corner reaches.

    OpenCV's own window takes in what lies behind foreshortened squares.
    """
    import cv2

    if len(uv) < 2:
        return uv.astype(np.float64)
    apart = np.linalg.norm(uv[:, None] - uv[None], axis=-1)
    nearest = np.where(apart > 0, apart, np.inf).min(1)
    reach = np.clip(_WINDOW * nearest, 2, _MOST_WINDOW).round().astype(int)
    found = uv.astype(np.float64)
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    for size in np.unique(reach):
        of_size = np.flatnonzero(reach == size)
        start = uv[of_size].reshape(-1, 1, 2).copy()
        moved = cv2.cornerSubPix(grey, start, (int(size), int(size)), (-1, -1), end).reshape(-1, 2)
        # A corner that runs away follows another edge: it stays where it was.
        near = np.linalg.norm(moved - uv[of_size], axis=-1) < size
        found[of_size[near]] = moved[near]
    return found


def other_boards(grey: np.ndarray, settings: BoardSettings) -> list[str]:
    """Dictionaries of which a photograph shows three markers or more, the likeliest first."""
    import cv2

    counts = {}
    for name in _LIKELY:
        if name != settings.dictionary.upper():
            dictionary = cv2.aruco.getPredefinedDictionary(_dictionary(name))
            _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
            counts[name] = 0 if ids is None else len(np.unique(ids))
    return sorted((n for n, count in counts.items() if count >= 3), key=lambda n: -counts[n])


def print_board(path: Path, settings: BoardSettings, paper: str) -> None:
    """Writes the board as a PDF page at true size, with a ruler to check the print.

    Raises:
        ConfigError: the board does not fit on the paper, or the file is no .pdf.
    """
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    from visdom_plugin.figures.canvas import drawing

    if path.suffix.lower() != ".pdf":
        raise ConfigError(
            f"the board is a PDF, and the name is {path.name}", where="--print-board", todo="name it .pdf"
        )
    with drawing(), appearing(path) as part:
        figure = draw_board(settings, paper)
        FigureCanvasPdf(figure).print_pdf(part, metadata={"CreationDate": None, "Title": "ChArUco board"})


def draw_board(settings: BoardSettings, paper: str) -> Figure:
    """The page as a figure of the paper's size; to be called within `figures.canvas.drawing`."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    if paper not in PAPERS:
        raise unknown_name(f"there is no paper {paper!r}", paper, PAPERS, where="--paper")
    wide, tall = PAPERS[paper]
    width, height = (side * 1000 for side in settings.size_m)
    foot = _UNPRINTABLE_MM + _FOOT_MM
    if width > wide - 2 * _UNPRINTABLE_MM or height > tall - _UNPRINTABLE_MM - foot:
        raise ConfigError(
            f"a board of {width:g} x {height:g} mm does not fit on {paper} ({wide:g} x {tall:g} mm)",
            where="--print-board",
            todo="use fewer squares, or a smaller --square-mm and --marker-mm, or a larger --paper",
        )
    left, bottom = (wide - width) / 2, foot + (tall - _UNPRINTABLE_MM - foot - height) / 2
    figure = Figure(figsize=(wide / _MM_PER_INCH, tall / _MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, wide), ylim=(0, tall), aspect="equal")
    axes.axis("off")
    for x, y, w, h in _black(settings):
        axes.add_patch(Rectangle((left + x, bottom + y), w, h, facecolor="black", linewidth=0))
    _draw_foot(axes, left, settings)
    return figure


def _black(settings: BoardSettings) -> list[tuple[float, float, float, float]]:
    """Black rectangles x, y, width, height in millimetres, origin in the board's lower left corner, y up."""
    board, edge = make_board(settings), settings.square_mm
    columns, rows = settings.squares
    picture = board.generateImage((columns * 20, rows * 20), marginSize=0)
    # A square's corner is beside its marker: black there is a black square.
    found = [
        (c * edge, (rows - 1 - r) * edge, edge, edge)
        for r in range(rows)
        for c in range(columns)
        if picture[20 * r + 1, 20 * c + 1] < 128
    ]
    dictionary = board.getDictionary()
    cells = dictionary.markerSize + 2
    mm = settings.marker_mm / cells
    for number, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
        x, y = 1000 * np.asarray(corners).reshape(4, 3)[0, :2]
        marker = dictionary.generateImageMarker(int(number), cells)
        for row, line in enumerate(marker < 128):
            ends = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
            for start, end in zip(ends[::2], ends[1::2], strict=True):
                below = rows * edge - y - (row + 1) * mm
                # Down to half a cell below where that is black, too: no viewer shows a seam between two rows.
                more = mm / 2 if row + 1 < cells and (marker[row + 1, start:end] < 128).all() else 0.0
                found.append((x + start * mm, below - more, (end - start) * mm, mm + more))
    return found


def _draw_foot(axes: Any, left: float, settings: BoardSettings) -> None:
    """A ruler and what the board is."""
    y = _UNPRINTABLE_MM + 8
    axes.plot([left, left + _RULER_MM], [y, y], color="black", linewidth=0.5, solid_capstyle="butt")
    for mm in range(0, _RULER_MM + 1, 5):
        length = 3 if mm % 50 == 0 else 2 if mm % 10 == 0 else 1
        axes.plot(
            [left + mm, left + mm], [y, y + length], color="black", linewidth=0.4, solid_capstyle="butt"
        )
    axes.text(
        left + _RULER_MM + 3,
        y,
        f"{_RULER_MM} mm: print at 100 %, not fitted to the page",
        fontsize=7,
        va="bottom",
    )
    text = (
        f"ChArUco {settings.squares[0]} x {settings.squares[1]}, squares {settings.square_mm:g} mm, markers "
        f"{settings.marker_mm:g} mm, {settings.dictionary.upper()}. Lay it flat; keep it still under the object."
    )
    axes.text(left, y - 4.5, text, fontsize=7, va="bottom")


def _dictionary(name: str) -> int:
    """OpenCV's number of a dictionary of markers."""
    import cv2

    known = {n.removeprefix("DICT_").upper(): n for n in dir(cv2.aruco) if n.startswith("DICT_")}
    asked = name.upper().removeprefix("DICT_")
    if asked not in known:
        raise unknown_name(
            f"there is no dictionary of markers {name!r}", asked, sorted(known), where="--dictionary"
        )
    return int(getattr(cv2.aruco, known[asked]))
