"""VisibleDomain: how a hull is carved. Free of heavy imports, so that command lines can show it at once."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from visdom_plugin.errors import ConfigError

log = logging.getLogger(__name__)

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class VisibleDomain:
    """Space that enough views see and whose views agree that it may be object.

    A voxel stays when it is inside the mask of at least `agreement` of the views that see its centre, and at
    least `k` views see it. A view sees a point that is in front of the camera and inside the image; that
    something else may be in the way does not count.

    Kinds: "visdom" is that rule. "traditional" is the same without `k`: one view is enough. "unit-sphere" is
    the traditional hull inside a ball. "released-go" is GaussianObject's published script: inside at least N - 1
    of the N masks, visibility not counted (points behind a camera are never inside its mask here).

    Automatic bounds are a cube of resolution ** 3 voxels around the space that can satisfy the rule, found from
    cameras and masks alone. The traditional hull, and "visdom" with k = 1, reach as far as any single camera
    sees; their cube holds the visible domain (of `k`, of 3 where that is 1, or of the largest smaller one that
    leaves any) and all camera centres. The default
    ball is centred on the visible domain's box and reaches its corners, and the cube holds the ball.
    """

    k: int | Literal["n-1", "auto"] = 3
    """K, the fewest views that must see a voxel. "n-1": all but one. "auto": the largest of 3, 2, 1 whose hull
    still covers the masks."""
    agreement: float = 0.95
    """Share of the views that see a voxel that must have it inside their mask, in (0, 1]."""
    max_misses: int | None = None
    """Views that may miss, in place of the agreement."""
    kind: Literal["visdom", "traditional", "unit-sphere", "released-go"] = "visdom"
    """Which hull of the paper's comparison."""
    bounds: Box | None = None
    """Lower and upper corner of the grid in world units, in place of automatic bounds."""
    resolution: int = 256
    """Voxels along the grid's longest side."""
    components: Literal["explain", "drop-small", "all", "largest"] = "explain"
    """Which connected pieces (26 neighbours) stay. "explain": those that cover foreground which no better piece
    covers, so that thin parts that broke off stay and pieces in front of or behind the object go, whatever their
    size. "drop-small": those not small beside the largest. "all". "largest". Where one view is enough
    ("traditional", "unit-sphere", k = 1) "explain" finds the bounds, but of the grid's pieces only small ones are
    dropped: what single views leave is what tells these kinds from the others."""
    min_component_fraction: float = 0.05
    """Pieces below this fraction of the largest piece's volume are small."""
    dilate_px: int = 0
    """Grow the masks by a square of 2 r + 1 pixels first."""
    sphere_centre: tuple[float, float, float] | None = None
    """Centre of the ball of "unit-sphere", world units."""
    sphere_radius: float | None = None
    """Radius of the ball of "unit-sphere", world units."""

    def __post_init__(self):
        def refuse(what: str, todo: str):
            raise ConfigError(what, where="VisibleDomain", todo=todo)

        if isinstance(self.k, bool) or not (
            self.k in ("n-1", "auto") or (isinstance(self.k, int) and self.k >= 1)
        ):
            refuse(f"k is {self.k!r}", 'use a whole number from 1, "n-1" or "auto"')
        if not 0 < self.agreement <= 1:
            refuse(f"agreement is {self.agreement}", "use a share in (0, 1], such as 0.95")
        if self.max_misses is not None and self.max_misses < 0:
            refuse(f"max_misses is {self.max_misses}", "use 0, 1, 2, ... or None")
        kinds = ("visdom", "traditional", "unit-sphere", "released-go")
        if self.kind not in kinds:
            refuse(f"kind is {self.kind!r}", f"use one of {', '.join(kinds)}")
        if self.components not in ("explain", "drop-small", "all", "largest"):
            refuse(f"components is {self.components!r}", "use explain, drop-small, all or largest")
        if not 0 <= self.min_component_fraction <= 1:
            refuse(f"min_component_fraction is {self.min_component_fraction}", "use a share in [0, 1]")
        if not 8 <= self.resolution <= 2048:
            refuse(f"resolution is {self.resolution}", "use 8 to 2048 voxels per side")
        if not 0 <= self.dilate_px <= 1000:
            refuse(f"dilate_px is {self.dilate_px}", "use 0 or more pixels")
        if self.sphere_radius is not None and not 0 < self.sphere_radius < math.inf:
            refuse(f"sphere_radius is {self.sphere_radius}", "use a positive length in world units")
        if self.bounds is not None:
            corners = [list(corner) for corner in self.bounds]
            shaped = len(corners) == 2 and all(len(c) == 3 for c in corners)
            if not shaped or not all(-math.inf < a < b < math.inf for a, b in zip(*corners, strict=True)):
                refuse(f"bounds are {self.bounds}", "use two corners (x, y, z), each lower below its upper")

    def carve(self, cameras, masks: Sequence) -> Hull:  # noqa: F821
        """Carves the hull.

        Masks on a CUDA device are voted there voxel by voxel; all others are carved block by block on the CPU,
        with the same result.

        Args:
            cameras: (N,) Cameras.
            masks: N tensors or arrays (H, W) bool, True on the object, or one (N, H, W).

        Returns:
            Hull. Its summary tells rule, bounds, pieces and seconds.

        Raises:
            EmptyHullError: when nothing is left, with the cause where it could be established.
            SceneError: when masks and cameras do not fit each other: in number or size, or, with automatic bounds,
                because the hull covers little of the masks and would cover them with poses of another convention.
        """
        from visdom_plugin.hull.carving.carve import carve

        return carve(self, cameras, masks)
