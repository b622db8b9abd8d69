"""Distance of a hull from a known surface: between points on both, and the volume they share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.grid.mesh import is_closed
from visdom_plugin.hull.hull import Hull

_NUDGE = np.array([0.3141e-6, 0.2718e-6])
"""Voxels that columns are moved by, so that none runs along a triangle's edge."""


class Chamfer(NamedTuple):
    """Mean squared distances, square scene units."""

    target_to_hull: float
    """Of points on the target to the nearest point on the hull."""
    hull_to_target: float

    @property
    def symmetric(self) -> float:
        """The sum of both (the paper's definition, with means over points in place of its sums)."""
        return self.target_to_hull + self.hull_to_target


def draw_on_surface(vertices: np.ndarray, faces: np.ndarray, count: int, *seed: int) -> np.ndarray:
    """(count, 3) points of a triangle mesh, uniform by area.

    Args:
        vertices, faces: (V, 3) and (F, 3).
        seed: non-negative integers; equal ones give equal points.

    Raises:
        ConfigError: for a mesh without area.
    """
    from trimesh import Trimesh
    from trimesh.sample import sample_surface

    mesh = Trimesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int64), process=False)
    if not len(mesh.faces) or not mesh.area > 0:
        raise ConfigError("a mesh without area has no points to measure distances to")
    return np.asarray(sample_surface(mesh, count, seed=np.random.default_rng(seed))[0])


def compare_points(target: np.ndarray, hull: np.ndarray) -> Chamfer:
    """Chamfer distances between two clouds of points, (M, 3) and (N, 3)."""
    from scipy.spatial import cKDTree

    ahead, back = cKDTree(hull).query(target)[0], cKDTree(target).query(hull)[0]
    return Chamfer(float(np.mean(ahead**2)), float(np.mean(back**2)))


def enclosed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume inside a closed outward mesh, by the divergence theorem."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def fill_mesh(
    vertices: np.ndarray, faces: np.ndarray, bounds: np.ndarray, shape: Sequence[int]
) -> np.ndarray:
    """(X, Y, Z) bool: the voxels whose centres an even-odd count finds inside a closed mesh.

    Args:
        bounds: (2, 3) corners of the grid.
        shape: voxels along x, y, z.
    """
    edge = (np.asarray(bounds[1]) - bounds[0]) / np.array(shape)
    # Units of voxels, in which the centre of voxel i lies at i.
    local = (np.asarray(vertices, np.float64) - bounds[0]) / edge - 0.5
    local[:, :2] += _NUDGE
    turns = np.zeros(tuple(shape), np.uint8)
    _turn_columns(np.ascontiguousarray(local), np.ascontiguousarray(faces, np.int64), turns)
    np.bitwise_xor.accumulate(turns, axis=2, out=turns)
    return turns.view(bool)


def overlap(hull: Hull, vertices: np.ndarray, faces: np.ndarray) -> dict[str, float | None]:
    """Volumes in cubic scene units and their intersection over union; None where the target is not closed.

    Returns:
        volume (of the hull), target_volume, iou, and covered, the share of the target inside the hull.
    """
    if not is_closed(np.asarray(faces)):
        return {"volume": hull.volume, "target_volume": None, "iou": None, "covered": None}
    target = abs(enclosed_volume(vertices, faces))
    inside = fill_mesh(vertices, faces, hull.bounds, hull.shape) & hull.occupancy
    # Counted in whole voxels, the part can come out a little larger than the whole.
    shared = min(float(np.count_nonzero(inside)) * hull.volume / max(hull.voxels, 1), target)
    return {
        "volume": hull.volume,
        "target_volume": target,
        "iou": shared / (target + hull.volume - shared),
        "covered": shared / target,
    }


@kernel()
def _turn_columns(vertices: np.ndarray, faces: np.ndarray, turns: np.ndarray) -> None:
    """Turns over, for each crossing of a column of centres with a face, the first voxel at or above it."""
    nx, ny, nz = turns.shape
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        double = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if double == 0:
            continue
        x0 = max(0, int(np.ceil(min(a[0], b[0], c[0]))))
        x1 = min(nx - 1, int(np.floor(max(a[0], b[0], c[0]))))
        y0 = max(0, int(np.ceil(min(a[1], b[1], c[1]))))
        y1 = min(ny - 1, int(np.floor(max(a[1], b[1], c[1]))))
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / double
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / double
                w = 1 - u - v
                if u >= 0 and v >= 0 and w >= 0:
                    z = max(0, int(np.ceil(u * a[2] + v * b[2] + w * c[2])))
                    if z < nz:
                        turns[x, y, z] ^= 1
