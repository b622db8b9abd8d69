"""Canvas: pictures at their own pixels with words between them, and figures as SVG, both by matplotlib.

Neither depends on the user's matplotlibrc nor on a display, and equal input gives equal bytes with one version of
matplotlib. Words may be in any script: letters that DejaVu Sans lacks come from the first of `FALLBACK_FONTS` that
is installed and has them. Where none has, a box stands in their place, one for each letter.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Colour = tuple[int, int, int]
FALLBACK_FONTS = (
    "Noto Sans", "Noto Sans CJK JP", "Noto Sans CJK SC", "Noto Sans CJK KR", "Source Han Sans", "IPAGothic",
    "WenQuanYi Zen Hei", "WenQuanYi Micro Hei", "Droid Sans Fallback", "Hiragino Sans", "Arial Unicode MS",
    "Unifont",
)  # fmt: skip
"""Families with letters outside the Latin, Greek, Cyrillic and Arabic scripts, on Linux and macOS."""
TIP = "tip "
"""Prefix of an artist's gid that becomes its tooltip in `to_svg`."""
_DPI = 72
"""A point is a pixel."""


@contextmanager
def drawing() -> Iterator[None]:
    """A block in which matplotlib has its own defaults, words are no formulas and missing letters no warnings."""
    from matplotlib import font_manager, style

    installed = set(font_manager.fontManager.get_font_names())
    fonts = ["DejaVu Sans", *(name for name in FALLBACK_FONTS if name in installed)]
    own = {"font.family": fonts, "font.size": 11, "text.parse_math": False, "figure.dpi": _DPI}
    own |= {"svg.fonttype": "none", "svg.hashsalt": "visdom-plugin"}
    with style.context(["default", own]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        yield


def printable(text: str) -> str:
    """One line of valid Unicode."""
    return " ".join(text.split()).encode("utf-8", "backslashreplace").decode()


class Canvas:
    """Pixels to paste pictures on and to write beside them."""

    def __init__(self, height: int, width: int, shade: int):
        """
        Args:
            height: in pixels.
            width: in pixels.
            shade: grey of the background, 0 to 255.
        """
        self.pixels = np.full((height, width, 3), shade, np.uint8)
        self._words: list[tuple[str, float, float, Colour, float]] = []

    def paste(self, picture: np.ndarray, x: int, y: int) -> None:
        """Puts a picture (h, w, 3) uint8 with its upper left corner at column x and row y."""
        self.pixels[y : y + picture.shape[0], x : x + picture.shape[1]] = picture

    def write(
        self, text: str, x: float, y: float, colour: Colour = (0, 0, 0), width: float = float("inf")
    ) -> None:
        """Writes one line that starts at column x; y is the row of its baseline.

        What is wider than `width` pixels loses its beginning: names differ at their end.
        """
        self._words.append((printable(text), x, y, colour, width))

    def draw(self) -> np.ndarray:
        """The picture, (height, width, 3) uint8 RGB; pasted pixels are there as they were."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        height, width = self.pixels.shape[:2]
        with drawing():
            # Matplotlib cuts fractions of a pixel off.
            figure = Figure(figsize=((width + 0.01) / _DPI, (height + 0.01) / _DPI), dpi=_DPI)
            figure.figimage(self.pixels, origin="upper")
            canvas = FigureCanvasAgg(figure)
            renderer = canvas.get_renderer()
            for text, x, y, colour, most in self._words:
                line = figure.text(x, height - y, text, color=np.array(colour) / 255, transform=None)
                while line.get_window_extent(renderer).width > most and len(text) > 1:
                    text = text[1:]
                    line.set_text("…" + text)
            canvas.draw()
            return np.array(canvas.buffer_rgba())[..., :3].copy()


def to_svg(figure: Figure, label: str) -> str:
    """A figure as an element of an HTML page; to be called within `drawing`.

    Args:
        figure: artists whose gid begins with TIP show the rest of it as a tooltip.
        label: for who cannot see the figure.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    file = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    FigureCanvasSVG(figure).print_svg(file, metadata=nothing)
    text = re.sub(f"<g id=([\"']){TIP}(.*?)\\1>", r"<g><title>\2</title>", file.getvalue(), flags=re.DOTALL)
    # Names that matplotlib gives to groups would be the same in every figure of a page.
    text = re.sub(r'<g id="[^"]*">', "<g>", text[text.index("<svg") :])
    box = re.search(r'viewBox="[^"]*"', text)
    body = text[text.index(">") + 1 :]
    return f'<svg class="figure" {box and box[0]} role="img" aria-label="{escape(label)}">{body}'.rstrip()
