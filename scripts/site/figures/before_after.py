"""The README's picture: four photographs, and unseen views by methods without and with the visible domain.

python scripts/site/figures/before_after.py [--runs DIR] [--out DIR]

The runs are those of the gallery. What is not in DIR yet is trained, half a minute to a minute each, by
OMP_NUM_THREADS=1 visdom-train method:NAME --data builtin:watering-can --views 4 --budget quick
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from trained import read_options, train

from datamodules import load
from visdom_plugin import Scene, Views
from visdom_plugin.figures.canvas import drawing
from visdom_plugin.figures.contact_sheet import picture_names, to_bytes
from visdom_plugin.training.metrics import whiten
from visdom_plugin.training.runs.run_directory import read_record

PICTURES = Path(__file__).parents[3] / "docs" / "pictures"
MAKES = ("before_after.webp",)
VIEWS = (4, 11)
"""Test views that are shown."""
METHODS = ("zipnerf-lite", "zipnerf-lite+vd", "3dgs-go", "visdom-gs")
TITLES = {
    "ingp": "Instant-NGP",
    "ingp+vd": "Instant-NGP\n+ visible domain",
    "zipnerf-lite": "Zip-NeRF",
    "zipnerf-lite+vd": "Zip-NeRF\n+ visible domain",
    "3dgs-go": "Gaussian splatting",
    "3dgs-go+vd": "Gaussian splatting\n+ visible domain",
    "visdom-gs": "visdom-gs",
}
"""What pictures call the methods, here and in the gallery."""


def main() -> None:
    """Draws the picture."""
    args = read_options(__doc__, PICTURES)
    runs = [train(args.runs, method) for method in METHODS]
    write_webp(compare(load(None, views=4), runs, VIEWS), args.out / MAKES[0])


def compare(scene: Scene, runs: Sequence[Path], shown: Sequence[int]) -> np.ndarray:
    """(H, W, 3) uint8: the scene's photographs, then unseen views in truth and by finished runs.

    Args:
        shown: positions of the test views, a row each.
    """
    names = picture_names(scene.test.names)
    columns = [("truth", [on_white(scene.test, i) for i in shown])]
    for run in runs:
        record = read_record(run)
        psnr = record["metrics"]["test"]["psnr"]
        pictures = [cv2.imread(str(run / "renders/test" / f"{names[i]}.png"))[..., ::-1] for i in shown]
        columns.append((f"{TITLES[record['method']]}\n{psnr:.1f} dB", pictures))
    return draw([on_white(scene.train, i) for i in range(len(scene.train))], columns)


def on_white(views: Views, index: int) -> np.ndarray:
    """(H, W, 3) uint8: a photograph without its background."""
    return to_bytes(whiten(views.images[index], views.masks[index]))


def draw(photographs: list[np.ndarray], columns: list[tuple[str, list[np.ndarray]]]) -> np.ndarray:
    """(H, W, 3) uint8: the photographs in a column of small ones at the left, then a column for each method."""
    rows, size = len(columns[0][1]), 2.3
    top, left = 0.75, rows * size / 4
    width, height = left + 0.35 + len(columns) * size, top + rows * size
    with drawing():
        figure = Figure((width, height), dpi=110, facecolor="white")

        def place(picture: np.ndarray, x: float, y: float, side: float, frame: bool = False) -> None:
            axes = figure.add_axes((x / width, 1 - (y + side) / height, side / width, side / height))
            axes.imshow(picture, interpolation="lanczos")
            axes.set(xticks=[], yticks=[])
            for edge in axes.spines.values():
                edge.set(visible=frame, color="0.75", linewidth=0.8)

        for i, photograph in enumerate(photographs):  # framed: they cut the object off
            place(photograph, 0.05, top + i * left + 0.03, left - 0.06, frame=True)
        figure.text(left / 2 / width, 1 - top / 2 / height, "4 photographs", ha="center", va="center")
        for c, (title, pictures) in enumerate(columns):
            x = left + 0.35 + c * size
            figure.text(
                (x + size / 2) / width, 1 - top / 2 / height, title, ha="center", va="center", size=12
            )
            for r, picture in enumerate(pictures):
                place(picture, x, top + r * size, size)
        return pixels_of(figure)


def pixels_of(figure: Figure) -> np.ndarray:
    """(H, W, 3) uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_webp(picture: np.ndarray, path: Path, quality: int = 85) -> None:
    """Writes (H, W, 3) RGB and says how large the file is."""
    cv2.imwrite(str(path), np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_WEBP_QUALITY, quality])
    print(f"{path}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
