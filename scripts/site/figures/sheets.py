"""Sheets of unseen views of the first built-in scene, a row per method and the truth on top.

python scripts/site/figures/sheets.py [--runs DIR] [--out DIR]

Trains what is not in DIR yet, half a minute to a minute each.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import cv2
from before_after import PICTURES, write_webp
from trained import read_options, train

from benchmarks.methods.compare_pictures import draw_runs


class Sheet(NamedTuple):
    """What one picture shows."""

    methods: tuple[str, ...]
    views: int = 4
    shown: int = 5
    """Test views, evenly spaced."""


SHEETS = {
    "built_in_4_views.webp": Sheet(("3dgs-go", "3dgs-go+mask", "3dgs-go+vd")),
    "fields_built_in_4_views.webp": Sheet(("zipnerf-lite", "zipnerf-lite+mask", "zipnerf-lite+vd")),
    "visdom_gs_built_in_4_views.webp": Sheet(("3dgs-go+vd", "visdom-gs"), shown=6),
    "visdom_gs_built_in_5_views.webp": Sheet(("3dgs-go+vd", "visdom-gs"), views=5, shown=6),
}
MAKES = tuple(SHEETS)
WIDTH = 1200
"""Of a picture, in pixels."""


def main() -> None:
    """Draws all sheets."""
    args = read_options(__doc__, PICTURES)
    for name, sheet in SHEETS.items():
        runs = [train(args.runs, method, sheet.views) for method in sheet.methods]
        picture = draw_runs(runs, sheet.shown)
        size = WIDTH, round(picture.shape[0] * WIDTH / picture.shape[1])
        write_webp(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), args.out / name)


if __name__ == "__main__":
    main()
