"""A painted chair with a woven seat: thin rods, and more air than wood."""

from __future__ import annotations

import numpy as np

from datamodules.synthetic.light import mirror, shade
from datamodules.synthetic.paint import wave
from datamodules.synthetic.shape import Shape
from datamodules.synthetic.solids import Solid, join, limb, path, slab

MIDDLE = (-0.06, 0.0, 0.79)
PARTS = ("post", "rung", "spindle", "rail", "seat")
_COLOURS = np.array(
    [(0.10, 0.42, 0.44), (0.86, 0.50, 0.12), (0.92, 0.88, 0.76), (0.72, 0.16, 0.14), (0.80, 0.68, 0.44)],
    np.float32,
)
_SEAT = 0.60


def shape() -> Shape:
    """It faces +x and stands on z = 0."""
    solids: list[Solid] = []
    for side in (-1, 1):
        solids.append(limb("post", (0.36, 0.38 * side, 0.03), (0.30, 0.33 * side, _SEAT), (0.026, 0.034)))
        back = [(-0.40, 0.34 * side, 0.03), (-0.31, 0.31 * side, _SEAT), (-0.37, 0.34 * side, 1.0)]
        solids += path("post", [*back, (-0.47, 0.37 * side, 1.34)], 0.031)
        for height, depth in ((0.20, 0.026), (0.36, 0.022)):
            ahead, behind = 0.342 - 0.06 * (height - 0.2), -0.373 + 0.16 * (height - 0.2)
            solids.append(
                limb(
                    "rung",
                    (ahead, 0.362 * side, height),
                    (behind, 0.33 * side, height + 0.04),
                    (depth, depth),
                    0.02,
                )
            )
        # Arms, bent down in front.
        arm = [(-0.36, 0.33 * side, 0.90), (0.05, 0.40 * side, 0.88), (0.24, 0.39 * side, 0.84)]
        solids += path("rail", [*arm, (0.29, 0.345 * side, _SEAT)], 0.026, 0.01)
    solids.append(limb("rung", (0.33, -0.36, 0.30), (0.33, 0.36, 0.30), (0.024, 0.024), 0.02))
    solids.append(limb("rung", (-0.36, -0.32, 0.28), (-0.36, 0.32, 0.28), (0.024, 0.024), 0.02))
    solids.append(slab("seat", (0.0, 0.0, _SEAT), (0.37, 0.37, 0.035), 0.03, 0.02))
    for y in (-0.18, -0.06, 0.06, 0.18):
        bowed = -0.42 + 0.5 * y * y
        solids += path(
            "spindle", [(-0.30, 0.95 * y, _SEAT), (bowed, y, 0.95), (-0.47, 1.1 * y, 1.28)], 0.021, 0.005
        )
    curve = [
        (-0.47, -0.38, 1.30),
        (-0.50, -0.20, 1.37),
        (-0.51, 0.0, 1.39),
        (-0.50, 0.20, 1.37),
        (-0.47, 0.38, 1.30),
    ]
    solids += path("rail", curve, 0.042, 0.01)
    return join(solids, PARTS, 0.0094)


def paint(points: np.ndarray, normals: np.ndarray, parts: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Colours (M, 3) float32 of surface points, seen along `away`."""
    x, y, z = points.T
    colours = _COLOURS[parts]

    def only(part: str, where: np.ndarray) -> np.ndarray:
        return (where & (parts == PARTS.index(part)))[:, None]

    # Bands of another colour round posts, rungs and rails, as a turner paints them.
    light, dark = np.array((0.95, 0.90, 0.72), np.float32), np.array((0.09, 0.17, 0.30), np.float32)
    colours = np.where(only("post", np.abs(wave(2.6 * z + 0.1)) < 0.22), light, colours)
    colours = np.where(only("post", wave(5.2 * z) > 0.85), np.array((0.85, 0.30, 0.14), np.float32), colours)
    along = np.where(np.abs(normals[:, 0]) > np.abs(normals[:, 1]), y, x)
    colours = np.where(only("rung", np.abs(wave(3.5 * along)) < 0.25), dark, colours)
    colours = np.where(only("rail", wave(4.1 * x + 3.3 * y) > 0.55), light, colours)
    colours = np.where(
        only("spindle", wave(3.1 * z + 1.7 * y) > 0.4), np.array((0.20, 0.44, 0.26), np.float32), colours
    )
    # The weave of the seat: strands over and under, in two colours.
    over = (wave(9.0 * x) > 0) ^ (wave(9.0 * y) > 0)
    strand = 0.80 + 0.20 * np.where(over, np.abs(wave(18 * x)), np.abs(wave(18 * y)))
    woven = np.where(over[:, None], colours, np.array((0.60, 0.36, 0.18), np.float32)) * strand[:, None]
    diamond = np.abs(x) + np.abs(y) < 0.20
    woven = np.where(diamond[:, None], woven * np.array((0.35, 0.60, 0.85), np.float32), woven)
    colours = np.where(only("seat", np.ones(len(x), bool)), woven, colours)
    gloss = 0.5 * (parts != PARTS.index("seat"))
    return np.clip(mirror(shade(colours, normals), normals, away, gloss), 0, 1).astype(np.float32)
