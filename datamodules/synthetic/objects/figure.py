"""A person in a striped shirt who waves: limbs apart, a hand at the hip, cloth and skin."""

from __future__ import annotations

import numpy as np

from datamodules.synthetic.light import shade
from datamodules.synthetic.paint import wave
from datamodules.synthetic.shape import Shape
from datamodules.synthetic.solids import ball, join, limb, slab

MIDDLE = (0.02, 0.02, 0.88)
PARTS = ("skin", "hair", "shirt", "trousers", "shoe", "scarf")
_COLOURS = np.array(
    [
        (0.86, 0.60, 0.46), (0.22, 0.12, 0.07), (0.90, 0.88, 0.82),
        (0.16, 0.24, 0.46), (0.62, 0.16, 0.12), (0.93, 0.66, 0.10),
    ],
    np.float32,
)  # fmt: skip


def shape() -> Shape:
    """It faces +x and stands on z = 0."""
    left, right = 1, -1
    return join(
        [
            # Legs, one a step ahead.
            limb("trousers", (0.0, 0.11 * left, 0.74), (0.10, 0.17 * left, 0.42), (0.115, 0.085), 0.03),
            limb("trousers", (0.10, 0.17 * left, 0.42), (0.04, 0.21 * left, 0.10), (0.085, 0.075), 0.02),
            limb("trousers", (0.0, 0.11 * right, 0.74), (-0.02, 0.16 * right, 0.42), (0.115, 0.085), 0.03),
            limb("trousers", (-0.02, 0.16 * right, 0.42), (-0.14, 0.18 * right, 0.10), (0.085, 0.075), 0.02),
            ball("shoe", (0.09, 0.23 * left, 0.055), (0.17, 0.075, 0.058), 0.015),
            ball("shoe", (-0.09, 0.20 * right, 0.055), (0.17, 0.075, 0.058), 0.015),
            # Trunk.
            ball("trousers", (0.0, 0.0, 0.76), (0.15, 0.20, 0.12), 0.05),
            ball("shirt", (0.0, 0.0, 0.95), (0.145, 0.185, 0.19), 0.03),
            ball("shirt", (0.0, 0.0, 1.08), (0.135, 0.225, 0.13), 0.07),
            # The arm that waves, and the one with its hand at the hip.
            limb("shirt", (0.0, 0.20 * left, 1.13), (0.02, 0.46 * left, 1.10), (0.078, 0.062), 0.03),
            limb("shirt", (0.02, 0.46 * left, 1.10), (0.06, 0.50 * left, 1.22), (0.062, 0.056), 0.02),
            limb("skin", (0.06, 0.50 * left, 1.22), (0.10, 0.53 * left, 1.40), (0.045, 0.038), 0.01),
            ball("skin", (0.115, 0.54 * left, 1.47), (0.035, 0.055, 0.07), 0.02),
            limb("skin", (0.115, 0.49 * left, 1.46), (0.125, 0.455 * left, 1.49), (0.02, 0.017), 0.01),
            limb("shirt", (0.0, 0.20 * right, 1.13), (-0.05, 0.43 * right, 0.97), (0.078, 0.062), 0.03),
            limb("skin", (-0.05, 0.43 * right, 0.97), (0.07, 0.23 * right, 0.83), (0.048, 0.040), 0.01),
            ball("skin", (0.09, 0.20 * right, 0.82), (0.06, 0.05, 0.04), 0.02),
            # Head.
            limb("skin", (0.0, 0.0, 1.16), (0.01, 0.0, 1.28), (0.065, 0.06), 0.02),
            ball("skin", (0.02, 0.0, 1.40), (0.118, 0.105, 0.14), 0.02),
            ball("skin", (0.135, 0.0, 1.385), (0.025, 0.02, 0.03), 0.02),
            ball("hair", (-0.015, 0.0, 1.445), (0.132, 0.124, 0.128), 0.0),
            limb("hair", (-0.12, 0.0, 1.43), (-0.22, 0.0, 1.22), (0.06, 0.02), 0.03),
            slab("scarf", (0.0, 0.0, 1.205), (0.105, 0.105, 0.032), 0.03, 0.02),
            limb("scarf", (0.10, 0.05, 1.20), (0.155, 0.08, 0.98), (0.04, 0.03), 0.02),
        ],
        PARTS,
        0.0115,
    )


def paint(points: np.ndarray, normals: np.ndarray, parts: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Colours (M, 3) float32 of surface points; the same from every side."""
    x, y, z = points.T

    def only(part: str, where: np.ndarray) -> np.ndarray:
        return (where & (parts == PARTS.index(part)))[:, None]

    colours = _COLOURS[parts]
    red, dark, white = (
        np.array(c, np.float32) for c in ((0.75, 0.10, 0.12), (0.06, 0.05, 0.06), (0.95, 0.94, 0.9))
    )
    colours = np.where(only("shirt", wave(8.2 * z + 0.4 * wave(0.9 * y)) > 0.0), red, colours)
    check = (wave(5.5 * y + 4.0 * z) > 0.2) ^ (wave(5.5 * y - 4.0 * z) > 0.2)
    colours = np.where(only("scarf", check), np.array((0.30, 0.42, 0.20), np.float32), colours)
    # Worn at the knees, darker along the seams at the sides.
    worn = (
        1
        + 0.30 * np.clip(1 - 9 * np.abs(z - 0.43), 0, 1) * (normals[:, 0] > 0)
        + 0.10 * wave(23 * z) * wave(19 * y)
    )
    colours = np.where(only("trousers", worn > 0), colours * worn[:, None], colours)
    colours = np.where(only("trousers", np.abs(z - 0.845) < 0.018), dark, colours)
    colours = np.where(only("shoe", z < 0.028), white, colours)
    colours = np.where(
        only("shoe", (np.abs(wave(14 * x)) < 0.35) & (z > 0.075) & (normals[:, 2] > 0.6)), white, colours
    )
    colours = np.where(
        only("hair", wave(9 * y + 3 * wave(1.3 * x + z)) > 0.45), np.float32(1.6) * colours, colours
    )
    # The face.
    front, side = x > 0.08, np.abs(y)
    eye = front & ((side - 0.042) ** 2 + 0.7 * (z - 1.42) ** 2 < 0.00030)
    brow = front & (np.abs(side - 0.045) < 0.028) & (np.abs(z - 1.458 + 0.1 * side) < 0.007)
    mouth = front & (side < 0.045) & (np.abs(z - 1.325 - 6 * side * side) < 0.008)
    cheek = np.clip(1 - ((side - 0.065) ** 2 + (z - 1.36) ** 2) / 0.0012, 0, 1) * front
    rosy = np.array((0.88, 0.42, 0.36), np.float32)
    skin = only("skin", np.ones(len(x), bool))
    colours = np.where(skin, colours + (0.6 * cheek[:, None]).astype(np.float32) * (rosy - colours), colours)
    colours = np.where(only("skin", eye | brow), dark, colours)
    colours = np.where(only("skin", mouth), red, colours)
    return np.clip(shade(colours, normals), 0, 1).astype(np.float32)
