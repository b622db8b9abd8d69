"""Draws a closed triangle mesh: exact visibility at sample points, many samples per pixel.

Scan conversion over all triangles at once: every triangle becomes one span per line of samples, every span
its samples, and the nearest wins. Triangles that share an edge compute its crossing with a line from the same
two points in the same order, so there are neither cracks nor doubles, and a sample is covered exactly when the
line of sight through it meets the mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Fragments(NamedTuple):
    """The visible surface at the covered samples."""

    sample: np.ndarray
    """(M,) int64 positions in the row-major grid of samples, rising."""
    face: np.ndarray
    """(M,) int64."""
    weights: np.ndarray
    """(M, 3) float64 barycentric coordinates on the face in space, not on the image."""


def rasterise(uv: np.ndarray, depth: np.ndarray, faces: np.ndarray, width: int, height: int) -> Fragments:
    """Visible fragments of a closed outward mesh that lies in front of the camera.

    Args:
        uv: (V, 2) float64 image coordinates in samples; sample (i, j) lies at (i + 0.5, j + 0.5).
        depth: (V,) float64, > 0.
        faces: (F, 3) int64, anticlockwise from outside.
        width, height: size of the grid of samples.
    """
    a, b, c = (uv[faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    front = np.flatnonzero(area < 0)  # v points down: anticlockwise faces have negative area
    face, line, left, right = _spans(uv, faces, front, width, height)
    run = right - left
    span = np.repeat(np.arange(len(run)), run)
    column = np.arange(len(span)) - np.repeat(np.cumsum(run) - run, run) + left[span]
    face, line = face[span], line[span]
    # Barycentric coordinates on the image are affine; divided by depth they become those in space.
    x, y = column + 0.5, line + 0.5
    corners = faces[face]
    p, q, r = (uv[corners[:, k]] for k in range(3))
    double = area[face]
    second = ((x - p[:, 0]) * (r[:, 1] - p[:, 1]) - (r[:, 0] - p[:, 0]) * (y - p[:, 1])) / double
    third = ((q[:, 0] - p[:, 0]) * (y - p[:, 1]) - (x - p[:, 0]) * (q[:, 1] - p[:, 1])) / double
    weights = np.stack([1 - second - third, second, third], -1) / depth[corners]
    nearness = weights[:, 0] + weights[:, 1] + weights[:, 2]
    sample = line * width + column
    order = np.lexsort((face, -nearness, sample))
    first = np.ones(len(order), bool)
    first[1:] = sample[order[1:]] != sample[order[:-1]]
    seen = order[first]
    return Fragments(sample[seen], face[seen], weights[seen] / nearness[seen, None])


def _spans(
    uv: np.ndarray, faces: np.ndarray, front: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Face, line, first and one-past-last column of every span of the given faces inside the grid."""
    corners = faces[front]
    # Sorted by (v, u): an edge then runs the same way in both of its triangles.
    rank = np.empty(len(uv), np.int64)
    rank[np.lexsort((uv[:, 0], uv[:, 1]))] = np.arange(len(uv))
    corners = np.take_along_axis(corners, np.argsort(rank[corners], axis=1), 1)
    lines = np.ceil(np.clip(uv[corners, 1] - 0.5, -1, height)).astype(np.int64).clip(0, height)
    count = lines[:, 2] - lines[:, 0]
    triangle = np.repeat(np.arange(len(corners)), count)
    line = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count) + lines[triangle, 0]
    top, middle, bottom = (corners[triangle, k] for k in range(3))
    upper = line < lines[triangle, 1]
    long = _crossing(uv, top, bottom, line)
    short = _crossing(uv, np.where(upper, top, middle), np.where(upper, middle, bottom), line)
    left, right = np.minimum(long, short), np.maximum(long, short)
    left, right = (
        np.ceil(np.clip(e - 0.5, -1, width)).astype(np.int64).clip(0, width) for e in (left, right)
    )
    some = right > left
    return front[triangle[some]], line[some], left[some], right[some]


def _crossing(uv: np.ndarray, start: np.ndarray, end: np.ndarray, line: np.ndarray) -> np.ndarray:
    (u0, v0), (u1, v1) = uv[start].T, uv[end].T
    return u0 + (line + 0.5 - v0) * ((u1 - u0) / (v1 - v0))
