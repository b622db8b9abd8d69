"""InsideConfig: how the shape inside a hull is found. Free of heavy imports."""

from __future__ import annotations

from dataclasses import dataclass

from visdom_plugin.errors import ConfigError


@dataclass(frozen=True)
class InsideConfig:
    """The smoothest full shape inside a hull that has the same silhouettes.

    From few views a hull has corners where silhouette cones meet, which no photograph supports. Among the shapes
    inside the hull that every ray through a mask meets, the one sought is smooth and still full; its energy is

        area - (2 / R) volume,

    so that a surface which no silhouette holds is rounded to the radius R. Shapes of given silhouettes: Franco,
    Lapierre and Boyer, Visual Shapes of Silhouette Sets (3DPVT 2006). The area under silhouette constraints: Kolev
    and Cremers, Integration of Multiview Stereo and Silhouettes via Convex Functionals on Convex Domains (ECCV
    2008); Kolev et al., Continuous Global Optimization in Multiview 3D Reconstruction (IJCV 2009).

    Their constraint, a sum along every ray of u in [0, 1], makes the problem convex, but a thin part meets it with
    small u everywhere and fades. Here a voxel is in or out, every ray must meet one that is in, and the hull
    itself flows down the energy: by diffusion and threshold (Merriman, Bence and Osher 1992; Esedoglu and Otto,
    Threshold Dynamics for Networks with Arbitrary Surface Tensions, CPAM 2015), from coarse to fine grids. After
    each step rays that lost their last voxel get a small ball back, placed along the ray by what it costs and how
    many views it serves. The result is a full shape near the hull; the least energy of all may be thin sheets.
    """

    radius: float = 2.0
    """R in units of the hull's radius, the distance from its centre to its farthest point."""
    resolution: int | None = None
    """Voxels along the hull's longest side at which the flow ends, in place of the hull's own grid; the shape is
    given on the hull's grid in any case."""
    steps: int = 60
    """Steps on the coarsest grid; each finer one takes half as many, but at least 8."""

    photo_weight: float = 0.0
    """How much of a voxel's surroundings must speak for it beyond half, where the photographs that see it show
    different colours; 0 leaves the shape to the silhouettes. Needs the photographs."""
    photo_tolerance: float = 0.3
    """Standard deviation of such colours, of 1, at which 1 - 1/e of that is asked."""

    def __post_init__(self) -> None:
        def refuse(what: str, todo: str) -> None:
            raise ConfigError(what, where="InsideConfig", todo=todo)

        if not 0 < self.radius <= 1000:
            refuse(f"radius is {self.radius}", "use a positive multiple of the hull's radius, such as 2")
        if self.resolution is not None and not 8 <= self.resolution <= 2048:
            refuse(
                f"resolution is {self.resolution}", "use 8 to 2048 voxels, or None for the hull's own grid"
            )
        if self.steps < 1:
            refuse(f"steps is {self.steps}", "use 1 or more")
        if not 0 <= self.photo_weight <= 0.5:
            refuse(f"photo_weight is {self.photo_weight}", "use 0 to 0.5, such as 0.15")
        if not 0 < self.photo_tolerance < float("inf"):
            refuse(f"photo_tolerance is {self.photo_tolerance}", "use a positive number, such as 0.3")
