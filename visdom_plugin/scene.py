"""Views and Scene: what a datamodule returns and everything else consumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from visdom_plugin.cameras import Cameras


@dataclass(frozen=True)
class Views:
    """Posed photographs with foreground masks. Sizes may differ from view to view."""

    cameras: Cameras
    """(N,) cameras, one per view."""
    images: Sequence[Tensor]
    """N tensors (H, W, 3) uint8, as photographed: the background is still there."""
    masks: Sequence[Tensor]
    """N tensors (H, W) bool, True on the object."""
    names: Sequence[str]
    """N names, unique, as in the data."""
    mono_depths: Sequence[Tensor | None] = ()
    """N tensors (H, W) float32 of monocular depth in its own arbitrary unit, or empty when there is none."""

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Scene:
    """A capture split into what training may see and what only the evaluator may see."""

    name: str
    train: Views
    test: Views
    units: str = "unknown"
    """What one unit of the world frame is: "metres", "unknown", ..."""
    source: dict[str, Any] = field(default_factory=dict)
    """Where it came from, for run.json: root, layout, downscale, hashes of the files read."""
    mesh: tuple[Tensor, Tensor] | None = None
    """Exact surface where it is known: vertices (V, 3) float64 and faces (F, 3) int64, outward."""
