"""Settings of the built-in scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from visdom_plugin.errors import ConfigError

_MOST_VIEWS = 16


@dataclass(frozen=True)
class SyntheticConfig:
    """The built-in scene's knobs. Noise goes to the training views only; test views stay exact."""

    size: int | tuple[int, int] = 200
    """Width and height of the photographs in pixels before `downscale`; one number for a square."""
    train_views: int = 4
    """2 to 16; fewer views are the first of more."""
    test_views: int = 16
    """0 or more."""
    downscale: float = 1.0
    """>= 1: the photographs come out at round(size / downscale)."""
    rotation_noise_deg: float = 0.0
    """Standard deviation of the error in each training camera's orientation."""
    translation_noise: float = 0.0
    """Standard deviation of the error in each training camera's position, as a fraction of its distance."""
    erode_px: int = 0
    """Training masks lose this many pixels at their edges."""
    dilate_px: int = 0
    """Training masks gain this many pixels at their edges, after the erosion."""
    flip_fraction: float = 0.0
    """Fraction of the training masks' pixels that are turned over at random."""
    truncation: float = 0.0
    """In [0, 1): every other training view is shifted sideways until about this fraction of the object's
    width lies outside the frame."""
    background: Literal["room", "white", "black"] = "room"
    """What the photographs show behind the object."""
    seed: int = 0
    """Of the noise."""

    @property
    def frame(self) -> tuple[int, int]:
        """Width and height in pixels, after `downscale`."""
        size = (self.size, self.size) if isinstance(self.size, int) else self.size
        width, height = (max(1, round(s / self.downscale)) for s in size)
        return width, height

    def check(self) -> None:
        """Raises ConfigError for a field out of its range."""
        downscale_fine = math.isfinite(self.downscale) and self.downscale >= 1
        checks = (
            ("downscale", downscale_fine, "1 or more"),
            (
                "size",
                not downscale_fine or 8 <= min(self.frame) <= max(self.frame) <= 8192,
                "8 to 8192 pixels",
            ),
            ("train_views", 2 <= self.train_views <= _MOST_VIEWS, f"2 to {_MOST_VIEWS}"),
            ("test_views", 0 <= self.test_views <= 360, "0 to 360"),
            ("rotation_noise_deg", 0 <= self.rotation_noise_deg <= 180, "0 to 180"),
            ("translation_noise", 0 <= self.translation_noise <= 1, "0 to 1"),
            ("erode_px", 0 <= self.erode_px <= 1000, "0 to 1000"),
            ("dilate_px", 0 <= self.dilate_px <= 1000, "0 to 1000"),
            ("flip_fraction", 0 <= self.flip_fraction <= 1, "0 to 1"),
            ("truncation", 0 <= self.truncation < 1, "0 to less than 1"),
            ("background", self.background in ("room", "white", "black"), "room, white or black"),
        )
        for name, fine, allowed in checks:
            if not fine:
                raise ConfigError(
                    f"the built-in scene's {name} is {getattr(self, name)!r}; it must be {allowed}",
                    where=name,
                )
