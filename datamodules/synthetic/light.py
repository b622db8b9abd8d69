"""Light on the built-in objects: matt shade, and what a glossy surface mirrors of the room."""

from __future__ import annotations

import numpy as np

from datamodules.synthetic.paint import LIGHT, room_colour


def shade(colours: np.ndarray, normals: np.ndarray, ambient: float = 0.62) -> np.ndarray:
    """Colours (M, 3) as matt paint shows them on surfaces with these normals (M, 3)."""
    light = normals[:, 0] * LIGHT[0] + normals[:, 1] * LIGHT[1] + normals[:, 2] * LIGHT[2]
    # From below comes only what the table sends back.
    lit = ambient + (1 - ambient) * np.maximum(light, 0) + 0.18 * np.minimum(normals[:, 2], 0)
    return colours * lit[:, None]


def mirror(
    colours: np.ndarray, normals: np.ndarray, away: np.ndarray, gloss: float | np.ndarray = 1.0
) -> np.ndarray:
    """Shaded colours (M, 3) under a clear coat that mirrors a bright window and, at grazing angles, the room.

    Args:
        normals: (M, 3) unit.
        away: (M, 3) unit, from the camera to the surface.
        gloss: of the coat, 0 to 1; one number, or (M,).
    """
    facing = away[:, 0] * normals[:, 0] + away[:, 1] * normals[:, 1] + away[:, 2] * normals[:, 2]
    back = away - 2 * facing[:, None] * normals
    grazing = 1 - np.clip(-facing, 0, 1)
    square = grazing * grazing
    share = (gloss * (0.05 + 0.55 * square * square * grazing))[:, None]
    # A window of two by two panes in the direction of the light.
    side = back[:, 1] * LIGHT[0] - back[:, 0] * LIGHT[1]
    up = back[:, 2] - LIGHT[2]
    ahead = back[:, 0] * LIGHT[0] + back[:, 1] * LIGHT[1] + back[:, 2] * LIGHT[2]
    panes = _within(side, 0.17) * _within(up, 0.13) * (1 - _within(side, 0.012)) * (1 - _within(up, 0.01))
    window = gloss * 0.7 * panes * (ahead > 0)
    mirrored = room_colour(back[:, 0], back[:, 1], back[:, 2])
    return colours * (1 - share) + mirrored * share + window[:, None].astype(np.float32)


def _within(x: np.ndarray, half: float) -> np.ndarray:
    """1 within `half` of 0 and 0 outside, with a soft edge."""
    return np.clip((half - np.abs(x)) * 40 + 0.5, 0, 1)
