"""Draws the built-in scenes, docs/pictures/built_in_scenes.webp: python scripts/site/figures/built_in_scenes.py"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from datamodules.built_in import NAMES
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene

MAKES = ("built_in_scenes.webp",)
PICTURE = Path(__file__).parents[3] / "docs/pictures" / MAKES[0]
SIZE, GAP = 280, 4
SHOWN = {"watering-can": (2, 5), "duck": (4, 2), "figure": (0, 4), "chair": (4, 3)}
"""Of each scene, a training view and a test view."""


def draw() -> np.ndarray:
    """(H, W, 3) uint8: a column per scene, a training view above a test view."""
    columns = []
    for name in NAMES:
        scene = make_scene(SyntheticConfig(size=SIZE, train_views=6, test_views=8), name)
        first, second = SHOWN[name]
        gap = np.full((GAP, SIZE, 3), 255, np.uint8)
        pair = [scene.train.images[first].numpy(), gap, scene.test.images[second].numpy()]
        columns += [np.concatenate(pair), np.full((2 * SIZE + GAP, GAP, 3), 255, np.uint8)]
    return np.concatenate(columns[:-1], 1)


if __name__ == "__main__":
    Image.fromarray(draw()).save(PICTURE, quality=88, method=6)
