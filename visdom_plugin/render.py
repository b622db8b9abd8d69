"""Rendered views: the value that methods return, and their rounding to 8 bits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Render:
    """One rendered view.

    `rgb` already contains the background: rgb = foreground + (1 - alpha) * background.
    """

    rgb: Tensor
    """(H, W, 3) colour, linear in the background, nominally in [0, 1] but not clamped."""
    alpha: Tensor
    """(H, W) accumulated opacity in [0, 1]."""
    depth: Tensor
    """(H, W) expected distance along the camera's z axis, divided by alpha; scene units; 0 where alpha is 0."""
    info: dict[str, Any] = field(default_factory=dict)
    """What the renderer wants to tell hooks and densification; keys are the renderer's own."""


def quantise(image: Tensor) -> Tensor:
    """An image as an 8-bit file would hold it: any shape, clamped to [0, 1], in steps of 1/255, float64."""
    return (image.double().clamp(0, 1) * 255).round() / 255
