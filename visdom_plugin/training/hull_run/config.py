"""Settings of a run that carves and measures a hull alone. Free of heavy imports."""

from __future__ import annotations

from dataclasses import dataclass, field

from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import VisibleDomain

METHOD = "hull"
"""What such a run calls itself in run.json, where others name their method."""


@dataclass(frozen=True)
class HullRunConfig:
    """Which hull, and how it is compared with the true surface."""

    hull: VisibleDomain = field(default_factory=VisibleDomain)
    """The hull."""
    samples: int = 100_000
    """Points drawn on each of the two surfaces."""
    target: str | None = None
    """Mesh file of the true surface, in the frame and units of the cameras; by default what the scene has."""

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ConfigError(
                f"samples = {self.samples} is out of range", where="HullRunConfig", todo="choose 1 or more"
            )
