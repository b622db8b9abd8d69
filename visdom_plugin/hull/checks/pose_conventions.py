"""What is said of poses that fit only when they are read in another way."""

from __future__ import annotations

from typing import NamedTuple


class PoseFault(NamedTuple):
    """One wrong way to hold poses."""

    what: str
    todo: str


class PoseFaults(NamedTuple):
    """A sentence for each wrong way, in the terms of where the poses are from."""

    turned: PoseFault
    """Right once the camera's y and z axes are turned round."""
    inverse: PoseFault
    """Right once inverted."""
    inverse_turned: PoseFault
    """Right once inverted, and the camera's y and z axes turned round then."""
    world_turned: PoseFault
    """Right once the world's y and z axes are turned round (shows in single views alone)."""


_TODO = 'hand the poses over in their own convention: convention="opengl", or the inverse matrices'
IN_MEMORY = PoseFaults(
    PoseFault("the poses have OpenGL axes (y up, z backward)", _TODO),
    PoseFault("the poses are world-to-camera matrices", _TODO),
    PoseFault("the poses are world-to-camera matrices with OpenGL axes", _TODO),
    PoseFault("the poses are inverted OpenGL matrices", _TODO),
)
"""Of cameras that a program handed over, which are camera-to-world with OpenCV axes."""
