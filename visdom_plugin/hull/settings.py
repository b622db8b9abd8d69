"""Settings of a hull as plain data; free of heavy imports, so that command lines can show them at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NoReturn

from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.wording import wording

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class HullSettings:
    """The keep rule, the grid it is asked on and the pieces that stay. Refuses values out of range when made."""

    k: int | Literal["n-1", "auto"] = 3
    """K, the fewest views that must see a voxel. "n-1": all but one. "auto": 3, or 2 where 3 loses more of a mask.
    It is --k of the commands and hull.k in tables; the matrix of intrinsics has nothing to do with it."""
    agreement: float = 0.95
    """Share of the views that see a voxel that must have it inside their mask, in (0, 1]: 0.95 means all of them
    where there are fewer than 20."""
    max_misses: int | None = None
    """In place of the agreement: how many of the views that see a voxel may have it outside their mask."""
    kind: Literal["visdom", "traditional", "unit-sphere", "released-go"] = "visdom"
    """Which hull of the paper's comparison: the visible domain, without K, that inside a ball, or GaussianObject's
    rule."""
    bounds: Box | None = None
    """Lower and upper corner of the grid in world units, in place of automatic bounds."""
    bounds_capture_radii: float | None = None
    """Half side of a cube around the cameras' mean, in largest distances of a camera from there, in place of
    automatic bounds. The VisDom authors' release has 2, with 512 voxels along a side; its mean is over all cameras
    of the capture, here over those that carve."""
    bounds_scale: float = 1.0
    """How much longer than found the automatic bounds are made, about their centre. The release doubles them for
    the points that Gaussians start from."""
    resolution: int = 256
    """Voxels along the grid's longest side."""
    components: Literal["explain", "drop-small", "all", "largest"] = "explain"
    """Which pieces stay: parts that touch nowhere (26 neighbours). "explain": those that cover foreground
    which no better piece covers, so that thin parts that broke off stay and pieces in front of or behind the
    object go, whatever their size. "drop-small": those not small beside the largest. "all". "largest". Where one
    view is enough ("traditional", "unit-sphere", k = 1) "explain" finds the bounds, but of the grid's pieces only
    small ones are dropped: what single views leave is what tells these kinds from the others."""
    min_component_fraction: float = 0.05
    """Pieces below this fraction of the largest piece's volume are small."""
    dilate_px: int = 0
    """Grow the masks by a square of 2 r + 1 pixels first."""
    sphere_centre: tuple[float, float, float] | None = None
    """Centre of the ball of "unit-sphere", world units."""
    sphere_radius: float | None = None
    """Radius of the ball of "unit-sphere", world units."""

    def __post_init__(self) -> None:
        def refuse(what: str, todo: str) -> NoReturn:
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
        radii = self.bounds_capture_radii
        if radii is not None and not (0 < radii < math.inf and self.bounds is None):
            refuse(f"bounds_capture_radii is {radii}", "use a positive number, and no bounds beside it")
        if not 1 <= self.bounds_scale < math.inf:
            refuse(f"bounds_scale is {self.bounds_scale}", "use 1 or more")
        if self.bounds is not None:
            corners = [list(corner) for corner in self.bounds]
            shaped = len(corners) == 2 and all(len(c) == 3 for c in corners)
            if not shaped or not all(-math.inf < a < b < math.inf for a, b in zip(*corners, strict=True)):
                refuse(f"bounds are {self.bounds}", "use two corners (x, y, z), each lower below its upper")

    def require_views(self, views: int) -> None:
        """Sees to it that there are enough views for K, before anything is carved.

        Args:
            views: with a mask.

        Raises:
            ConfigError: K is above their number.
        """
        if self.kind == "visdom" and isinstance(self.k, int):
            refuse_large_k(self.k, views)


def refuse_large_k(k: int, views: int) -> None:
    """Raises ConfigError for a K above the number of views that carve."""
    if k <= views:
        return
    said = wording()
    fewer = f"; or a smaller K: {said.set_k.format(k=min(3, views))}" if views > 1 else ""
    raise ConfigError(
        f"K = {k} is more than the {views} view{'s' * (views != 1)} trained on: nothing is seen by {k} of them",
        where=said.set_k.format(k=k),
        todo=said.more_views.format(count=k) + fewer,
    )
