"""The surface of an occupancy grid: marching cubes for binary values, closed by construction.

The 256 cases are generated, not listed. On each face of a cube of eight voxel centres the surface's trace is
decided by that face's four corners alone (diagonal neighbours stay apart), so two cubes that share a face agree
on it and the segments close into loops. A loop is triangulated without a diagonal inside a face of the cube,
because such an edge could coincide with one of the neighbour's. Every edge of the mesh therefore belongs to
exactly two triangles, run in opposite directions (vertices may touch, as two voxels that meet at a corner do).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for

_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
_FACES = [(axis, side) for axis in range(3) for side in range(2)]
_MOST_TRIANGLES = 5


def _face_corners(axis: int, side: int) -> list[int]:
    """The face's corners in circular order, anticlockwise seen from outside the cube."""
    u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
    base = side << axis
    ring = [base, base + u, base + u + v, base + v]
    return ring if side else ring[::-1]


def _segments(case: int) -> dict[int, int]:
    """Directed traces on the six faces, from edge to edge; loops of them run anticlockwise from outside."""
    following = {}
    for axis, side in _FACES:
        ring = _face_corners(axis, side)
        inside = [case >> c & 1 for c in ring]
        for start in range(4):
            # A run of inside corners enters at the edge before it and leaves at the edge after it.
            if inside[start] and not inside[start - 1]:
                end = start
                while inside[(end + 1) % 4]:
                    end += 1
                following[_edge_of(ring[start - 1], ring[start])] = _edge_of(
                    ring[end % 4], ring[(end + 1) % 4]
                )
    return following


def _edge_of(a: int, b: int) -> int:
    return _EDGES.index((min(a, b), max(a, b)))


def _loops(case: int) -> list[list[int]]:
    following, loops = _segments(case), []
    while following:
        first, edge = next(iter(following.items()))
        loop = [first]
        del following[first]
        while edge != first:
            loop.append(edge)
            edge = following.pop(edge)
        loops.append(loop)
    return loops


def _share_face(a: int, b: int) -> bool:
    corners = [*_EDGES[a], *_EDGES[b]]
    return any(len({c >> axis & 1 for c in corners}) == 1 for axis in range(3))


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a polygon whose diagonals keep off the cube's faces, or None."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    n = len(loop)
    for ear in range(n):
        before, after = loop[ear - 1], loop[(ear + 1) % n]
        if not _share_face(before, after):
            rest = _triangulate(loop[:ear] + loop[ear + 1 :])
            if rest is not None:
                return [(before, loop[ear], after), *rest]
    return None


@lru_cache(maxsize=1)
def _cases() -> tuple[np.ndarray, np.ndarray]:
    """Triangles (256, 5, 3) as edges 0..11, and how many of them each case has."""
    triangles, counts = np.zeros((256, _MOST_TRIANGLES, 3), np.int64), np.zeros(256, np.int64)
    for case in range(256):
        found = [t for loop in _loops(case) for t in _triangulate(loop) or ()]
        counts[case] = len(found)
        if found:
            triangles[case, : len(found)] = found
    return triangles, counts


_EDGE_AXES = np.array([(a ^ b).bit_length() - 1 for a, b in _EDGES])
_EDGE_OFFSETS = _CORNERS[[a for a, _ in _EDGES]]


@kernel(inline="always")
def _case_at(grid: np.ndarray, i: int, j: int, k: int) -> int:
    # Cube (i, j, k) has voxel centres i - 1 and i along x, and so on; beyond the grid all is empty.
    nx, ny, nz = grid.shape
    case = 0
    for corner in range(8):
        a, b, c = i - 1 + (corner & 1), j - 1 + (corner >> 1 & 1), k - 1 + (corner >> 2)
        if a >= 0 and b >= 0 and c >= 0 and a < nx and b < ny and c < nz and grid[a, b, c]:
            case |= 1 << corner
    return case


@kernel(inline="always")
def _next_cube(grid: np.ndarray, i: int, j: int, k: int) -> int:
    """The first k' >= k at which the four columns around the cube's corner change between k' - 1 and k'."""
    nx, ny, nz = grid.shape
    if 1 <= i < nx and 1 <= j < ny:
        while 1 <= k < nz:
            same = True
            for a in range(i - 1, i + 1):
                for b in range(j - 1, j + 1):
                    if (
                        grid[a, b, k - 1] != grid[i - 1, j - 1, k - 1]
                        or grid[a, b, k] != grid[i - 1, j - 1, k - 1]
                    ):
                        same = False
            if not same:
                return k
            k += 1
    return k


@kernel()
def _count_slabs(
    begin: int, end: int, grid: np.ndarray, counts: np.ndarray, triangles_of: np.ndarray,
    vertices_of: np.ndarray,
) -> None:  # fmt: skip
    _, ny, nz = grid.shape
    for i in range(begin, end):
        triangles, vertices = 0, 0
        for j in range(ny + 1):
            k = 0
            while True:
                k = _next_cube(grid, i, j, k)
                if k > nz:
                    break
                case = _case_at(grid, i, j, k)
                triangles += counts[case]
                # This cube owns the three edges that leave its first corner.
                first = case & 1
                for axis in range(3):
                    vertices += (case >> (1 << axis) & 1) != first
                k += 1
        triangles_of[i], vertices_of[i] = triangles, vertices


@kernel()
def _number_slab(grid: np.ndarray, i: int, first: int, ids: np.ndarray, vertices: np.ndarray) -> None:
    """Numbers and places the vertices that slab i owns."""
    _, ny, nz = grid.shape
    count = first
    for j in range(ny + 1):
        k = 0
        while True:
            k = _next_cube(grid, i, j, k)
            if k > nz:
                break
            case = _case_at(grid, i, j, k)
            for axis in range(3):
                if (case >> (1 << axis) & 1) != (case & 1):
                    ids[j, k, axis] = count
                    vertices[count, 0], vertices[count, 1], vertices[count, 2] = i - 0.5, j - 0.5, k - 0.5
                    vertices[count, axis] += 0.5
                    count += 1
            k += 1


@kernel()
def _build(
    first: int, last: int, grid: np.ndarray, chunks: int, table: np.ndarray, counts: np.ndarray,
    axes: np.ndarray, offsets: np.ndarray, first_triangle: np.ndarray, first_vertex: np.ndarray,
    vertices: np.ndarray, faces: np.ndarray,
) -> None:  # fmt: skip
    nx, ny, nz = grid.shape
    for chunk in range(first, last):
        begin, end = chunk * (nx + 1) // chunks, (chunk + 1) * (nx + 1) // chunks
        here, ahead = np.empty((ny + 2, nz + 2, 3), np.int64), np.empty((ny + 2, nz + 2, 3), np.int64)
        if begin < end:
            _number_slab(grid, begin, first_vertex[begin], here, vertices)
        for i in range(begin, end):
            if i < nx:
                _number_slab(grid, i + 1, first_vertex[i + 1], ahead, vertices)
            f = first_triangle[i]
            for j in range(ny + 1):
                k = 0
                while True:
                    k = _next_cube(grid, i, j, k)
                    if k > nz:
                        break
                    case = _case_at(grid, i, j, k)
                    for t in range(counts[case]):
                        for m in range(3):
                            e = table[case, t, m]
                            ids = ahead if offsets[e, 0] else here
                            faces[f, m] = ids[j + offsets[e, 1], k + offsets[e, 2], axes[e]]
                        f += 1
                    k += 1
            here, ahead = ahead, here


def mesh_grid(occupancy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed outward surface of a bool grid.

    Args:
        occupancy: (X, Y, Z) bool.

    Returns:
        Vertices (V, 3) float64 in units of voxels, where voxel i spans [i, i + 1], and faces (F, 3) int64,
        anticlockwise seen from outside. Both are empty for an empty grid.
    """
    grid = np.ascontiguousarray(occupancy).view(np.uint8)
    table, counts = _cases()
    slabs = grid.shape[0] + 1
    triangles_of, vertices_of = np.zeros(slabs, np.int64), np.zeros(slabs, np.int64)
    parallel_for(_count_slabs, slabs, 16, grid, counts, triangles_of, vertices_of)
    vertices = np.empty((int(vertices_of.sum()), 3))
    faces = np.empty((int(triangles_of.sum()), 3), np.int64)
    first_triangle = np.concatenate([[0], np.cumsum(triangles_of)])
    first_vertex = np.concatenate([[0], np.cumsum(vertices_of)])
    chunks = min(4, slabs)
    inputs = (grid, chunks, table, counts, _EDGE_AXES, _EDGE_OFFSETS, first_triangle, first_vertex)
    parallel_for(_build, chunks, 1, *inputs, vertices, faces)
    return vertices, faces


def is_closed(faces: np.ndarray) -> bool:
    """Whether every edge of a mesh (F, 3) is in exactly two faces, which run along it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    count = int(edges.max(initial=0)) + 1
    ahead, back = (np.sort(edges[:, a] * count + edges[:, 1 - a]) for a in (0, 1))
    return bool(np.array_equal(ahead, back) and (np.diff(ahead) > 0).all())
