"""The built-in object: a watering can as one closed triangle mesh, exact by construction.

A profile turned round the z axis gives the hollow body on its foot (a concavity); where spout, handle and
bail leave the wall, a block of its quads is taken out and a tube is sewn to the hole's edge, vertex for
vertex. Handle and bail come back to the wall and so make two holes of the surface (genus 2). Nothing
overlaps: the mesh is the boundary of the solid.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

PARTS = ("body", "inside", "foot", "spout", "handle", "bail")

_AROUND = 72
_RINGS = 92
# (radius, height) of the turned profile: from the middle of the foot's underside, up the outside, over the
# rim, down the inside to the middle of its floor.
_PROFILE = [
    (0, 0.03), (0.18, 0.03), (0.27, 0), (0.33, 0.01), (0.32, 0.06), (0.24, 0.11), (0.25, 0.16),
    (0.37, 0.24), (0.47, 0.38), (0.49, 0.52), (0.45, 0.66), (0.36, 0.78), (0.31, 0.86), (0.33, 0.92),
    (0.38, 0.96), (0.37, 0.98), (0.31, 0.93), (0.275, 0.86), (0.32, 0.77), (0.405, 0.66), (0.44, 0.52),
    (0.42, 0.39), (0.34, 0.28), (0.18, 0.22), (0, 0.21),
]  # fmt: skip
_FOOT_TOP, _FLOOR, _RIM = 0.12, 0.21, 0.98


class Shape(NamedTuple):
    """A closed, outward surface in its own frame: z up, standing on z = 0, about 2 x 1 x 1.4 units."""

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """(F, 3) int64, anticlockwise from outside."""
    parts: np.ndarray
    """(F,) int64 index into PARTS."""
    normals: np.ndarray
    """(V, 3) float64 unit vertex normals, averaged by area."""


def watering_can() -> Shape:
    """The object; the same numbers on every call."""
    body = _Body()
    # Paths lie in a vertical plane through the axis; columns are (outward, height) or (across, height).
    spout = [
        (0.48, 0.36),
        (0.62, 0.38),
        (0.78, 0.52),
        (0.90, 0.78),
        (1.00, 1.02),
        (1.05, 1.10),
        (1.075, 1.14),
    ]
    radii = [0.085, 0.075, 0.055, 0.042, 0.038, 0.075, 0.100]
    body.sew_tube(_plane(spout, 0.0), radii, start=(0.0, 0.36), block=4, steps=34, part="spout")
    handle = [
        (0.45, 0.68),
        (0.60, 0.76),
        (0.78, 0.70),
        (0.83, 0.52),
        (0.74, 0.36),
        (0.58, 0.30),
        (0.46, 0.36),
    ]
    body.sew_tube(_plane(handle, np.pi), [0.04] * 7, start=(np.pi, 0.68), end=(np.pi, 0.36), block=3, steps=36,
                  part="handle")  # fmt: skip
    bail = [(-0.34, 0.81), (-0.43, 0.86), (-0.47, 1.05), (-0.33, 1.33), (0.0, 1.42)]
    bail += [(-x, z) for x, z in bail[-2::-1]]
    body.sew_tube(_plane(bail, -np.pi / 2, mirror=True), [0.022] * 9, start=(np.pi / 2, 0.81),
                  end=(-np.pi / 2, 0.81), block=2, steps=56, part="bail")  # fmt: skip
    return body.finish()


def _plane(points: ArrayLike, azimuth: float, mirror: bool = False) -> np.ndarray:
    flat = np.asarray(points, np.float64)
    along = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return flat[:, :1] * along + flat[:, 1:] * np.array([0.0, 0.0, 1.0])


def _smooth(points: np.ndarray, count: int) -> np.ndarray:
    """(count, D) points spread evenly along the uniform Catmull-Rom curve through (N, D) points."""
    points = np.asarray(points, np.float64)
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = np.linspace(0, 1, 24, endpoint=False)[:, None]
    spans = []
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        spans.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    fine = np.concatenate([*spans, points[-1:]])
    length = np.concatenate([[0.0], np.linalg.norm(np.diff(fine, axis=0), axis=1).cumsum()])
    where = np.linspace(0, length[-1], count)
    return np.stack([np.interp(where, length, column) for column in fine.T], -1)


class _Body:
    """The turned body as a grid of quads, from which blocks are taken out for the tubes."""

    def __init__(self) -> None:
        profile = _smooth(np.array(_PROFILE), _RINGS + 2)
        self.rings = profile[1:-1]
        angle = np.arange(_AROUND) * (2 * np.pi / _AROUND)
        r, z = self.rings[:, :1], self.rings[:, 1:]
        grid = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z, (_RINGS, _AROUND))], -1)
        poles = np.array([[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]])
        self.vertices = [grid.reshape(-1, 3), poles]
        self.count = grid.shape[0] * grid.shape[1] + 2
        self.quads = np.ones((_RINGS - 1, _AROUND), bool)
        self.faces: list[np.ndarray] = []
        self.parts: list[np.ndarray] = []
        self.rim = int(self.rings[:, 1].argmax())

    def sew_tube(
        self,
        path: np.ndarray,
        radii: Sequence[float],
        *,
        start: tuple[float, float],
        block: int,
        steps: int,
        part: str,
        end: tuple[float, float] | None = None,
    ) -> None:
        """A tube of round cross-section along `path`, from the wall at `start` (azimuth, height) to the wall
        at `end`, or to a dished cap."""
        curve = _smooth(np.concatenate([path, np.asarray(radii)[:, None]], -1), steps)
        centres, radius = curve[:, :3], curve[:, 3]
        tangent = np.gradient(centres, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # The path is planar: one axis of every cross-section is the plane's normal.
        across = np.cross(path[1] - path[0], path[-1] - path[0])
        across /= np.linalg.norm(across)
        normal = np.cross(across, tangent)
        loop = self._open(start, block)
        phase = self._angles(loop, normal[0], across)
        rings = centres[1:-1, None] + radius[1:-1, None, None] * (
            np.cos(phase)[:, None] * normal[1:-1, None] + np.sin(phase)[:, None] * across
        )
        rows = [loop, *self._add(rings)]
        if end is None:
            last, t = rings[-1], tangent[-1]
            middle = centres[-2]
            dish = np.stack([middle + 0.82 * (last - middle), middle + 0.75 * (last - middle) - 0.025 * t])
            rows += list(self._add(dish))
            (tip,) = self._add((middle - 0.03 * t)[None])
            fan = np.stack([rows[-1], np.roll(rows[-1], -1), np.full(len(loop), tip)], -1)
            self._emit(fan, part)
        else:
            far = self._open(end, block)[::-1]
            angles = self._angles(far, normal[-1], across)
            turns = [np.cos(np.roll(angles, -k) - phase).sum() for k in range(len(far))]
            rows.append(np.roll(far, -int(np.argmax(turns))))
        for one, two in pairwise(rows):
            self._strip(one, two, part)

    def finish(self) -> Shape:
        index = np.arange(_RINGS * _AROUND).reshape(_RINGS, _AROUND)
        height = self.rings[:, 1]
        for row in range(_RINGS - 1):
            kept = self.quads[row]
            a, b = index[row], index[row + 1]
            quads = np.stack([a, np.roll(a, -1), np.roll(b, -1), b], -1)[kept]
            part = "inside" if row >= self.rim else "foot" if height[row] < _FOOT_TOP else "body"
            self._emit(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), part)
        low, high = _RINGS * _AROUND, _RINGS * _AROUND + 1
        first, last = index[0], index[-1]
        self._emit(np.stack([np.roll(first, -1), first, np.full(_AROUND, low)], -1), "foot")
        self._emit(np.stack([last, np.roll(last, -1), np.full(_AROUND, high)], -1), "inside")
        vertices, faces = np.concatenate(self.vertices), np.concatenate(self.faces)
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3).astype(np.int64)
        return Shape(vertices, faces, np.concatenate(self.parts), vertex_normals(vertices, faces))

    def _open(self, where: tuple[float, float], block: int) -> np.ndarray:
        """Takes out block x block quads round (azimuth, height) on the outside; the hole's edge, (4 block,)
        vertex indices, anticlockwise from outside."""
        azimuth, height = where
        column = round(azimuth / (2 * np.pi) * _AROUND - block / 2)
        foot = int(np.abs(self.rings[: self.rim, 1] - height).argmin())
        row = foot - block // 2
        columns = (column + np.arange(block + 1)) % _AROUND
        self.quads[row : row + block, columns[:-1]] = False
        low, high = row * _AROUND + columns, (row + block) * _AROUND + columns
        sides = np.arange(row + 1, row + block) * _AROUND
        return np.concatenate([low, sides + columns[-1], high[::-1], (sides + columns[0])[::-1]])

    def _angles(self, loop: np.ndarray, normal: np.ndarray, across: np.ndarray) -> np.ndarray:
        corners = np.concatenate(self.vertices)[loop]
        away = corners - corners.mean(0)
        return np.arctan2(away @ across, away @ normal)

    def _add(self, points: np.ndarray) -> np.ndarray:
        self.vertices.append(points.reshape(-1, 3))
        first, self.count = self.count, self.count + points.size // 3
        return np.arange(first, self.count).reshape(points.shape[:-1])

    def _strip(self, one: np.ndarray, two: np.ndarray, part: str) -> None:
        a, b, c, d = one, np.roll(one, -1), np.roll(two, -1), two
        self._emit(np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]), part)

    def _emit(self, faces: np.ndarray, part: str) -> None:
        self.faces.append(faces)
        self.parts.append(np.full(len(faces), PARTS.index(part), np.int64))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals: the faces' normals averaged with their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack(
        [
            np.bincount(faces.reshape(-1), np.repeat(across[:, k], 3), minlength=len(vertices))
            for k in range(3)
        ],
        -1,
    )
    return total / np.linalg.norm(total, axis=1, keepdims=True)
