"""A rubber duck with a striped scarf: smooth, glossy, of few colours."""

from __future__ import annotations

import numpy as np

from datamodules.synthetic.light import mirror, shade
from datamodules.synthetic.paint import wave
from datamodules.synthetic.shape import Shape
from datamodules.synthetic.solids import ball, join, limb

MIDDLE = (0.0, 0.0, 0.62)
PARTS = ("rubber", "beak", "white", "scarf")
_COLOURS = np.array(
    [(0.98, 0.74, 0.06), (0.95, 0.36, 0.05), (0.96, 0.96, 0.93), (0.12, 0.32, 0.66)], np.float32
)


def shape() -> Shape:
    """It looks along +x and sits on z = 0."""
    return join(
        [
            ball("rubber", (0.0, 0.0, 0.40), (0.62, 0.46, 0.40)),
            limb("rubber", (-0.42, 0.0, 0.52), (-0.70, 0.0, 0.80), (0.20, 0.04), 0.16),
            ball("rubber", (-0.06, 0.40, 0.46), (0.34, 0.10, 0.20), 0.05),
            ball("rubber", (-0.06, -0.40, 0.46), (0.34, 0.10, 0.20), 0.05),
            ball("rubber", (0.30, 0.0, 0.98), 0.34, 0.10),
            *[
                limb("scarf", a, b, (0.055, 0.055), 0.03)
                for a, b in zip(_ring(), [*_ring()[1:], _ring()[0]], strict=True)
            ],
            limb("scarf", (0.46, 0.20, 0.68), (0.56, 0.34, 0.42), (0.06, 0.05), 0.04),
            ball("beak", (0.63, 0.0, 0.95), (0.20, 0.17, 0.045), 0.03),
            ball("beak", (0.60, 0.0, 0.89), (0.15, 0.13, 0.035), 0.02),
            *[ball("white", (0.50, side * 0.17, 1.10), (0.09, 0.08, 0.11), 0.01) for side in (-1, 1)],
        ],
        PARTS,
        0.013,
    )


def _ring() -> list[tuple[float, float, float]]:
    """Round the neck, at the corners of a polygon."""
    half = 3**0.5 / 2
    corners = [(1, 0), (half, 0.5), (0.5, half), (0, 1), (-0.5, half), (-half, 0.5)]
    corners += [(-x, -y) for x, y in corners]
    return [(0.24 + 0.27 * x, 0.29 * y, 0.72 + 0.03 * x) for x, y in corners]


def paint(points: np.ndarray, normals: np.ndarray, parts: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Colours (M, 3) float32 of surface points, seen along `away`."""
    x, y, z = points.T
    colours = _COLOURS[parts]
    scarf = parts == PARTS.index("scarf")
    stripe = wave(3.3 * x + 2.9 * y + 5.0 * z) > 0.1
    colours = np.where((scarf & stripe)[:, None], np.float32(0.93), colours)
    pupil = (x - 0.585) ** 2 + (np.abs(y) - 0.205) ** 2 + 0.6 * (z - 1.11) ** 2 < 0.0022
    colours = np.where((pupil & (parts == PARTS.index("white")))[:, None], np.float32(0.04), colours)
    # The mould's halves meet along the middle, and the dye is not quite even.
    seam = np.clip(1.2 - np.abs(y) * 120, 0, 1) * (parts == PARTS.index("rubber"))
    tone = 1 - 0.25 * seam + 0.05 * wave(0.8 * x + 0.3 * z) + 0.03 * wave(1.9 * y - 0.7 * x)
    colours = colours * tone[:, None]
    return np.clip(mirror(shade(colours, normals), normals, away), 0, 1).astype(np.float32)
