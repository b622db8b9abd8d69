"""Colours of the built-in scene: a glazed can, the table it stands on and the room behind.

Only additions, multiplications, divisions, roots and rounding are used: unlike sines they are rounded alike
everywhere, so the pictures are the same on every machine.
"""

from __future__ import annotations

import numpy as np

from datamodules.synthetic.shape import PARTS

LIGHT = np.array([0.48, -0.36, 0.80], np.float32)
_PALETTES = {
    "body": [(0.05, 0.20, 0.62), (0.98, 0.78, 0.10), (0.02, 0.55, 0.60), (0.93, 0.90, 0.82), (0.86, 0.16, 0.12)],
    "inside": [(0.95, 0.55, 0.12), (0.98, 0.72, 0.30), (0.90, 0.42, 0.10), (0.99, 0.82, 0.50), (0.85, 0.35, 0.15)],
    "foot": [(0.45, 0.08, 0.35), (0.65, 0.12, 0.45), (0.85, 0.60, 0.15), (0.45, 0.08, 0.35), (0.30, 0.05, 0.30)],
    "spout": [(0.10, 0.62, 0.25), (0.85, 0.92, 0.20), (0.05, 0.42, 0.30), (0.10, 0.62, 0.25), (0.95, 0.95, 0.85)],
    "handle": [(0.90, 0.25, 0.10), (0.98, 0.88, 0.75), (0.90, 0.25, 0.10), (0.70, 0.10, 0.10), (0.98, 0.60, 0.15)],
    "bail": [(0.75, 0.10, 0.55), (0.98, 0.90, 0.30), (0.75, 0.10, 0.55), (0.20, 0.15, 0.60), (0.98, 0.90, 0.30)],
}  # fmt: skip
_BANDS = np.array([_PALETTES[part] for part in PARTS], np.float32)
_INSIDE = PARTS.index("inside")
_TABLE_RADIUS = 2.1


def wave(x: np.ndarray) -> np.ndarray:
    """A parabola's likeness of sin(2 pi x): period 1, range [-1, 1]."""
    x = x - np.rint(x)
    return x * (8 - 16 * np.abs(x))


def paint_object(points: np.ndarray, normals: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Colours of surface points, the same from every side.

    Args:
        points: (M, 3) float32 in the shape's own frame.
        normals: (M, 3) float32 in the same frame, nearly unit length.
        parts: (M,) index into PARTS.

    Returns:
        (M, 3) float32 in [0, 1].
    """
    x, y, z = points.T
    wx = x + 0.05 * wave(1.9 * y + 1.3 * z)
    wy = y + 0.05 * wave(1.7 * z + 1.1 * x)
    wz = z + 0.035 * wave(2.3 * x + 0.7 * y) + 0.02 * wave(5.1 * y - 2.0 * x)
    band = np.floor(9 * wz + 2 * (wx - wy)).astype(np.int64)
    colour = _BANDS[parts, band % 5]
    # Petals: cells of a warped lattice take the colour two bands on.
    petal = wave(2.6 * wx + 0.1) * wave(2.6 * wy - 0.2) + 0.55 * wave(3.1 * wz)
    colour = np.where((petal > 0.42)[:, None], _BANDS[parts, (band + 2) % 5], colour)
    outline = np.abs(petal - 0.42) < 0.06
    colour = np.where(outline[:, None], np.float32(0.10), colour)
    fine = wave(9.3 * x + 1.7 * wave(3 * y)) * wave(8.7 * y + 1.3 * wave(3 * z)) + wave(
        10.1 * z + wave(4 * x)
    )
    shade = 1 + 0.10 * fine
    light = normals[:, 0] * LIGHT[0] + normals[:, 1] * LIGHT[1] + normals[:, 2] * LIGHT[2]
    shade = shade * (0.70 + 0.30 * light)
    # Light reaches the bottom of the can and the table's side of the foot only in part.
    sunk = np.where(
        parts == _INSIDE, np.clip((z - 0.15) / 0.8, 0.15, 1.0), np.clip(0.55 + 2.2 * z, 0.55, 1.0)
    )
    return np.clip(colour * (shade * sunk)[:, None], 0, 1).astype(np.float32)


def paint_room(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What lies behind the object: the table at z = 0 and a blurred room far away.

    Args:
        origin: (3,) the camera's centre in the shape's frame.
        directions: (M, 3) float32 unit, same frame.

    Returns:
        (M, 3) float32 in [0, 1].
    """
    dx, dy, dz = directions.T
    room = room_colour(dx, dy, dz)
    down = np.minimum(dz, np.float32(-1e-4))
    t = np.float32(-origin[2]) / down
    x, y = np.float32(origin[0]) + t * dx, np.float32(origin[1]) + t * dy
    out = np.sqrt((x - np.float32(0.1)) ** 2 + y**2)
    edge = np.clip((_TABLE_RADIUS - out) * 25, 0, 1) * (dz < -1e-4) * (origin[2] > 0)
    return room + edge[:, None].astype(np.float32) * (_table(x, y) - room)


def room_colour(dx: np.ndarray, dy: np.ndarray, dz: np.ndarray) -> np.ndarray:
    """(M, 3) float32 of the blurred room in unit directions."""
    height = np.clip(0.5 + 0.9 * dz, 0, 1)[:, None]
    low, high = np.array([0.34, 0.28, 0.25], np.float32), np.array([0.62, 0.72, 0.78], np.float32)
    glow = (
        0.10 * wave(0.9 * dx + 0.6 * dy)
        + 0.06 * wave(1.7 * dy - 1.1 * dz + 0.3)
        + 0.04 * wave(3.1 * dx + 2 * dz)
    )
    tint = np.array([1.0, 0.8, 0.5], np.float32)
    return np.clip(low + height * (high - low) + glow[:, None] * tint, 0, 1).astype(np.float32)


def _table(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    plank = np.floor(2.4 * x)
    tone = 0.07 * wave(plank * np.float32(0.37)) + 0.05 * wave(plank * np.float32(0.173) + 0.2)
    grain = wave(6.5 * x + 0.8 * wave(0.9 * y + plank * np.float32(0.31))) * (
        0.5 + 0.5 * wave(0.7 * y + plank * np.float32(0.61))
    )
    seam = np.abs(2.4 * x - np.rint(2.4 * x)) < 0.025
    shade = (0.62 + tone + 0.05 * grain) * np.where(seam, 0.6, 1.0)
    near = ((x - np.float32(0.05)) / np.float32(0.55)) ** 2 + ((y - np.float32(0.03)) / np.float32(0.5)) ** 2
    shade = shade * (1 - 0.6 / (1 + near * near))
    colour = np.array([1.0, 0.74, 0.48], np.float32)
    return np.clip(shade[:, None] * colour, 0, 1).astype(np.float32)
