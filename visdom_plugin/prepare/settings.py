"""Settings of visdom-prepare as plain data; free of heavy imports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from visdom_plugin.errors import ConfigError

MaskWay = Literal["auto", "given", "grabcut", "rembg", "none"]
Volume = tuple[float, float, float, float, float, float]
"""Lower corner x, y, z and upper corner of a box in the scene's units."""


@dataclass(frozen=True)
class BoardSettings:
    """The printed ChArUco board. The default fits on A4 and on US letter."""

    squares: tuple[int, int] = (7, 10)
    """Squares of the board along its short and its long side."""
    square_mm: float = 25.0
    """Edge of a square in millimetres, as printed."""
    marker_mm: float = 18.0
    """Edge of a marker, its black frame included."""
    dictionary: str = "4X4_50"
    """Markers of the board: 4X4_50, 5X5_100, APRILTAG_36H11 and so on, by OpenCV's names."""
    legacy: bool = False
    """The board is laid out as by OpenCV before 4.6: with an even number of rows, it begins with a marker."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the board in metres."""
        return self.squares[0] * self.square_mm / 1000, self.squares[1] * self.square_mm / 1000

    def check(self) -> None:
        """Raises ConfigError for a board that cannot be."""
        if min(self.squares) < 3 or max(self.squares) > 60:
            raise ConfigError(
                f"--squares is {self.squares[0]} {self.squares[1]}", todo="use 3 to 60 along each side"
            )
        if not 0 < self.marker_mm < self.square_mm < 10_000:
            raise ConfigError(
                f"markers of {self.marker_mm:g} mm do not fit into squares of {self.square_mm:g} mm",
                where="--marker-mm, --square-mm",
                todo="measure both on the print; the marker is the smaller one",
            )


@dataclass(frozen=True)
class MaskSettings:
    """How the object is told from its background."""

    source: MaskWay = "auto"
    """auto: the masks that are there, else grabcut. given: only those. grabcut: OpenCV's, from colours and the
    hull. rembg: its networks. none: no masks."""
    box: Volume | None = None
    """The object lies in this box, in scene units (metres on a board, from its middle, z up): x y z of the lower
    and of the upper corner."""
    height: float | None = None
    """The object is not taller than this above the board, in metres; by default the board's long side."""
    rounds: int = 2
    """Rounds in which the views' hull corrects their masks; 0 for none."""
    models: str | None = None
    """Folder that holds rembg's models (.onnx)."""
    model: str = "isnet-general-use"
    """Name of rembg's model."""
