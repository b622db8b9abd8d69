"""Solids as signed distances, blended into one another, and the closed mesh round them.

Only additions, multiplications, divisions, roots and comparisons are used, all of them component by component, so
that the mesh has the same bits on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from datamodules.synthetic.shape import Shape, vertex_normals

Point = tuple[float, float, float]
Distance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(x, y, z), each (...), to the distance from the solid's surface, below 0 inside."""


class Solid(NamedTuple):
    """One solid of several."""

    part: str
    """What it is painted as."""
    distance: Distance
    low: Point
    high: Point
    """Corners of a box that holds it."""
    blend: float
    """Over what length it runs into those before it; 0 for a crease."""


def limb(part: str, start: Point, end: Point, radii: tuple[float, float], blend: float = 0.0) -> Solid:
    """Ball-ended, from `start` to `end` with a radius at each."""
    a, b = np.array(start), np.array(end)
    along = b - a
    square = float(along[0] * along[0] + along[1] * along[1] + along[2] * along[2])

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        x, y, z = x - a[0], y - a[1], z - a[2]
        t = np.clip((x * along[0] + y * along[1] + z * along[2]) / square, 0, 1)
        return _length(x - t * along[0], y - t * along[1], z - t * along[2]) - (
            radii[0] + t * (radii[1] - radii[0])
        )

    low, high = np.minimum(a - radii[0], b - radii[1]), np.maximum(a + radii[0], b + radii[1])
    return Solid(part, distance, _point(low), _point(high), blend)


def path(part: str, points: Sequence[Point], radius: float, blend: float = 0.0) -> list[Solid]:
    """Limbs of one radius from each point to the next."""
    return [limb(part, a, b, (radius, radius), blend) for a, b in pairwise(points)]


def ball(part: str, centre: Point, radii: Point | float, blend: float = 0.0) -> Solid:
    """An ellipsoid along the axes, or a ball."""
    c, r = np.array(centre), np.broadcast_to(np.asarray(radii, np.float64), 3)

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        x, y, z = (x - c[0]) / r[0], (y - c[1]) / r[1], (z - c[2]) / r[2]
        away = _length(x, y, z)
        return away * (away - 1) / np.maximum(_length(x / r[0], y / r[1], z / r[2]), 1e-9)

    return Solid(part, distance, _point(c - r), _point(c + r), blend)


def slab(part: str, centre: Point, half: Point, rounding: float, blend: float = 0.0) -> Solid:
    """A box along the axes with round edges; `half` is half its size."""
    c, h = np.array(centre), np.array(half)

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        x, y, z = (np.abs(v - c[i]) - (h[i] - rounding) for i, v in enumerate((x, y, z)))
        outside = _length(np.maximum(x, 0), np.maximum(y, 0), np.maximum(z, 0))
        return outside + np.minimum(np.maximum(np.maximum(x, y), z), 0) - rounding

    return Solid(part, distance, _point(c - h), _point(c + h), blend)


def join(solids: Sequence[Solid], parts: Sequence[str], cell: float) -> Shape:
    """The closed surface of all of them together.

    Args:
        parts: names that faces are numbered by.
        cell: side of the cells that the surface is found on, in units of the solids; each gets one vertex.
    """
    # Off the planes that solids are symmetric about, on which distances would be 0 at corners of cells.
    low = np.array([s.low for s in solids]).min(0) - cell * np.array([3.37, 3.41, 3.29])
    high = np.array([s.high for s in solids]).max(0) + 3 * cell
    count = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[k] + cell * np.arange(count[k]) for k in range(3)]
    field = np.full(count, 10.0)
    for solid in solids:
        # Beyond this margin a solid is positive and changes nothing.
        margin = solid.blend + 2 * cell
        box = tuple(
            slice(*np.searchsorted(axis, (solid.low[k] - margin, solid.high[k] + margin)))
            for k, axis in enumerate(axes)
        )
        x, y, z = np.meshgrid(*(axis[part] for axis, part in zip(axes, box, strict=True)), indexing="ij")
        field[box] = _blend(field[box], solid.distance(x, y, z), solid.blend)
    vertices, faces = _enclose(field)
    vertices = low + cell * vertices
    # A face belongs to the solid whose surface is nearest to its middle.
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    x, y, z = ((a + b + c) / 3).T
    away = np.stack([np.abs(solid.distance(x, y, z)) for solid in solids])
    number = np.array([parts.index(solid.part) for solid in solids])
    return Shape(vertices, faces, number[away.argmin(0)], vertex_normals(vertices, faces))


def _enclose(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in cells, and faces (F, 3), outward, round what is below 0: surface nets (Gibson 1998)."""
    inside = field < 0
    cells = tuple(n - 1 for n in field.shape)
    places, numbers = [], []
    edges = []
    for axis in range(3):
        one, two = (
            tuple(slice(i, i - 1 or None) if k == axis else slice(None) for k in range(3)) for i in (0, 1)
        )
        cut = inside[one] != inside[two]
        at = np.argwhere(cut)
        t = field[one][cut] / (field[one][cut] - field[two][cut])
        edges.append((axis, at, inside[one][cut]))
        others = [k for k in range(3) if k != axis]
        for step in ((0, 0), (-1, 0), (0, -1), (-1, -1)):  # the four cells round an edge
            cell = at.copy()
            cell[:, others] += step
            place = at.astype(np.float64)
            place[:, axis] += t
            places.append(place)
            numbers.append(np.ravel_multi_index(tuple(cell.T), cells))
    some, index = np.unique(np.concatenate(numbers), return_inverse=True)
    crossings = np.bincount(index)
    place = np.concatenate(places)
    middles = np.stack([np.bincount(index, place[:, k]) / crossings for k in range(3)], -1)
    quads = []
    for axis, at, first_inside in edges:
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corners = []
        for du, dv in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            cell = at.copy()
            cell[:, u] += du
            cell[:, v] += dv
            corners.append(np.searchsorted(some, np.ravel_multi_index(tuple(cell.T), cells)))
        quad = np.stack(corners, -1)
        quads.append(np.where(first_inside[:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    return middles, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def _blend(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    """The smaller of two distances; where they differ by less than `length`, a little below it."""
    if not length:
        return np.minimum(a, b)
    near = np.maximum(length - np.abs(a - b), 0) / length
    return np.minimum(a, b) - near * near * (length / 4)


def _length(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.sqrt(x * x + y * y + z * z)


def _point(values: np.ndarray) -> Point:
    x, y, z = values.tolist()
    return x, y, z
