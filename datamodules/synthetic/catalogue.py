"""The built-in objects by name: their surface, their paint and the point that cameras look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from datamodules.built_in import DEFAULT
from datamodules.synthetic.paint import paint_object
from datamodules.synthetic.shape import Shape, watering_can

Paint = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Surface points (M, 3), unit normals (M, 3), parts (M,) and unit directions from the camera (M, 3), all in the
shape's frame, to colours (M, 3) float32 in [0, 1]."""


@dataclass(frozen=True)
class BuiltIn:
    """An object that scenes are drawn of. It stands on z = 0, about 2 x 1 x 1.4 units large."""

    shape: Shape
    paint: Paint
    middle: tuple[float, float, float]
    """What cameras look at, in the shape's frame."""


def find_object(name: str) -> BuiltIn:
    """The object of a name out of `datamodules.built_in.NAMES`; the same numbers on every call."""
    if name == DEFAULT:

        def paint_can(
            points: np.ndarray, normals: np.ndarray, parts: np.ndarray, away: np.ndarray
        ) -> np.ndarray:
            return paint_object(points, normals, parts)

        return BuiltIn(watering_can(), paint_can, (0.13, 0.0, 0.66))
    module = import_module(f"datamodules.synthetic.objects.{name}")
    return BuiltIn(module.shape(), module.paint, module.MIDDLE)
