"""Rays through the masks, which a shape must meet, and the voxels that are given back to those that miss it.

Each square of pixels about as large as a voxel's image has at most one ray: through the mask's pixel nearest to
the square's centre, so that no part of a mask is without rays, however thin it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import Grid, Silhouettes

_MET, _MISSED = 1, 2
_LEAST_COST = 0.05
"""Of a voxel, in units of the blurred shape: one at the cut is not free."""


@dataclass(frozen=True)
class Rays:
    """Rays of all views in units of a grid's voxels, and the squares of pixels they stand for."""

    origins: np.ndarray
    """(N, 3) float64 camera centres, voxels from the grid's lower corner."""
    directions: np.ndarray
    """(M, 3) float64 voxels per unit of camera depth."""
    views: np.ndarray
    """(M,) int64 view of each ray."""
    squares: np.ndarray
    """(M,) int64 square of each ray; those of all views are numbered one view after the other, row by row."""
    projections: np.ndarray
    """(N, 3, 4) float64: a point in voxels to homogeneous coordinates in its view's squares."""
    sizes: np.ndarray
    """(N, 2) int64 columns and rows of squares."""
    starts: np.ndarray
    """(N + 1,) int64 number of each view's first square, and of all squares."""

    def __len__(self) -> int:
        return len(self.views)

    def that_meet(self, filled: np.ndarray) -> Rays:
        """Only the rays that meet a voxel of (X, Y, Z) uint8 that is not 0."""
        met = find_met(self, filled)[self.squares] == _MET
        return replace(
            self, directions=self.directions[met], views=self.views[met], squares=self.squares[met]
        )


def choose_pixels(mask: np.ndarray, edge: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The foreground pixel nearest to the centre of each square of the mask that has any.

    Args:
        mask: (H, W) bool or 0/1.
        edge: of a square, pixels.

    Returns:
        squares (M,), numbered row by row, and the pixels' rows (M,) and columns (M,).
    """
    height, width = mask.shape
    tall, wide = -(-height // edge), -(-width // edge)
    padded = np.zeros((tall * edge, wide * edge), bool)
    padded[:height, :width] = mask
    pixels = padded.reshape(tall, edge, wide, edge).transpose(0, 2, 1, 3).reshape(tall * wide, -1)
    squares = np.flatnonzero(pixels.any(1))
    y, x = np.divmod(np.arange(edge * edge), edge)
    nearest_first = np.argsort(np.hypot(y - (edge - 1) / 2, x - (edge - 1) / 2), kind="stable")
    place = nearest_first[pixels[squares][:, nearest_first].argmax(1)]
    return squares, squares // wide * edge + place // edge, squares % wide * edge + place % edge


def draw_rays(cameras: Cameras, silhouettes: Silhouettes, grid: Grid, *, every_pixel: bool = False) -> Rays:
    """Rays through the masks.

    Args:
        cameras: (N,) cameras on the CPU.
        silhouettes: their masks.
        grid: its voxels are the unit.
        every_pixel: make squares of one pixel, not of the image of a voxel in the grid's middle.
    """
    count = len(silhouettes)
    projections, sizes, starts = np.empty((count, 3, 4)), np.empty((count, 2), np.int64), [0]
    motion, intrinsics = cameras.world_from_camera.double().numpy(), cameras.intrinsics.double().numpy()
    world_from_voxels = np.diag([grid.voxel] * 3 + [1.0])
    world_from_voxels[:3, 3] = grid.lower
    directions, squares, views = [], [], []
    for view in range(count):
        mask, K, projection = silhouettes.mask(view), intrinsics[view], silhouettes.projections[view]
        depth = float(projection[2, :3] @ grid.bounds.mean(0) + projection[2, 3])
        image = min(K[0, 0], K[1, 1]) * grid.voxel / depth if depth > 0 else 1.0
        edge = 1 if every_pixel else int(np.clip(image, 1, max(mask.shape)))
        square, rows, columns = choose_pixels(mask, edge)
        x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
        directions.append(np.stack([x, y, np.ones(len(x))], -1) @ motion[view, :3, :3].T / grid.voxel)
        squares.append(starts[-1] + square)
        views.append(np.full(len(x), view))
        sizes[view] = -(-mask.shape[1] // edge), -(-mask.shape[0] // edge)
        starts.append(starts[-1] + int(sizes[view].prod()))
        projections[view] = np.diag([1 / edge, 1 / edge, 1.0]) @ projection @ world_from_voxels
    origins = (motion[:, :3, 3] - grid.lower) / grid.voxel
    lines = np.concatenate(directions), np.concatenate(views), np.concatenate(squares)
    return Rays(origins, *lines, projections, sizes, np.array(starts))


@kernel(inline="always")
def _enter(
    origin: np.ndarray, direction: np.ndarray, shape: tuple[int, ...], voxel: np.ndarray, step: np.ndarray,
    ahead: np.ndarray, apart: np.ndarray,
) -> bool:  # fmt: skip
    """Puts a ray at its first voxel; returns whether it meets the grid at all.

    Comes out: the voxel, +-1 along each axis, t of the next plane along each axis, t between planes.
    """
    near, far = 0.0, np.inf
    for a in range(3):
        if direction[a] == 0:
            if not 0 <= origin[a] < shape[a]:
                return False
        else:
            t0, t1 = -origin[a] / direction[a], (shape[a] - origin[a]) / direction[a]
            near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    if not near < far:
        return False
    for a in range(3):
        i = min(max(int(np.floor(origin[a] + near * direction[a])), 0), shape[a] - 1)
        voxel[a], step[a], ahead[a], apart[a] = i, 0, np.inf, np.inf
        if direction[a] != 0:
            step[a], apart[a] = (1 if direction[a] > 0 else -1), abs(1 / direction[a])
            ahead[a] = (i + (direction[a] > 0) - origin[a]) / direction[a]
    return True


@kernel(inline="always")
def _go_on(
    shape: tuple[int, ...], voxel: np.ndarray, step: np.ndarray, ahead: np.ndarray, apart: np.ndarray,
) -> bool:  # fmt: skip
    """Takes a ray to its next voxel; returns whether that is in the grid."""
    a = 0 if ahead[0] <= ahead[1] and ahead[0] <= ahead[2] else (1 if ahead[1] <= ahead[2] else 2)
    voxel[a] += step[a]
    ahead[a] += apart[a]
    return 0 <= voxel[a] < shape[a]


@kernel()
def _meet(
    begin: int, end: int, origins: np.ndarray, directions: np.ndarray, views: np.ndarray,
    squares: np.ndarray, filled: np.ndarray, state: np.ndarray,
) -> None:  # fmt: skip
    shape = filled.shape
    voxel, step, ahead, apart = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for r in range(begin, end):
        met = False
        on = _enter(origins[views[r]], directions[r], shape, voxel, step, ahead, apart)
        while on and not met:
            met = filled[voxel[0], voxel[1], voxel[2]] != 0
            on = _go_on(shape, voxel, step, ahead, apart)
        state[squares[r]] = _MET if met else _MISSED


@kernel(inline="always")
def _count_missed(
    view: int, i: int, j: int, k: int, projections: np.ndarray, sizes: np.ndarray, starts: np.ndarray,
    state: np.ndarray,
) -> int:  # fmt: skip
    """Views in which a voxel lies on a ray that misses the shape; `view` is one."""
    count = 1
    x, y, z = i + 0.5, j + 0.5, k + 0.5
    for v in range(len(sizes)):
        p = projections[v]
        w = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        if v != view and w > 0:
            column = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / w
            row = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / w
            if 0 <= column < sizes[v, 0] and 0 <= row < sizes[v, 1]:
                count += state[starts[v] + int(row) * sizes[v, 0] + int(column)] == _MISSED
    return count


@kernel()
def _choose(
    begin: int, end: int, missed: np.ndarray, origins: np.ndarray, directions: np.ndarray, views: np.ndarray,
    projections: np.ndarray, sizes: np.ndarray, starts: np.ndarray, cap: np.ndarray, blurred: np.ndarray,
    cut: float, state: np.ndarray, chosen: np.ndarray,
) -> None:  # fmt: skip
    shape = cap.shape
    voxel, step, ahead, apart = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for m in range(begin, end):
        r, best = missed[m], 0.0
        chosen[m] = -1
        on = _enter(origins[views[r]], directions[r], shape, voxel, step, ahead, apart)
        while on:
            i, j, k = voxel[0], voxel[1], voxel[2]
            if cap[i, j, k]:
                worth = _count_missed(views[r], i, j, k, projections, sizes, starts, state)
                score = worth / (_LEAST_COST + max(cut - blurred[i, j, k], 0.0))
                if score > best:
                    best, chosen[m] = score, (i * shape[1] + j) * shape[2] + k
            on = _go_on(shape, voxel, step, ahead, apart)


@kernel()
def _fill_balls(centres: np.ndarray, ball: float, cap: np.ndarray, u: np.ndarray) -> None:
    nx, ny, nz = u.shape
    reach = int(ball)
    for m in range(len(centres)):
        i, j, k = centres[m] // (ny * nz), centres[m] // nz % ny, centres[m] % nz
        for x in range(max(i - reach, 0), min(i + reach + 1, nx)):
            for y in range(max(j - reach, 0), min(j + reach + 1, ny)):
                for z in range(max(k - reach, 0), min(k + reach + 1, nz)):
                    if cap[x, y, z] and (x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2 <= ball * ball:
                        u[x, y, z] = 1


def find_met(rays: Rays, filled: np.ndarray) -> np.ndarray:
    """What became of the ray of each square: uint8, 0 without a ray, 1 where it meets what is filled, else 2.

    Args:
        filled: (X, Y, Z) uint8, not 0 where a voxel is filled.
    """
    state = np.zeros(int(rays.starts[-1]), np.uint8)
    lines = (rays.origins, rays.directions, rays.views, rays.squares)
    parallel_for(_meet, len(rays), 1024, *lines, filled, state)
    return state


def give_back(
    rays: Rays, u: np.ndarray, cap: np.ndarray, blurred: np.ndarray, cut: float, ball: float = 0.0
) -> int:
    """Gives rays that miss the shape a ball each, in place.

    Its centre is the voxel on the ray that serves most views for least energy, which is greedy weighted set cover:
    a voxel costs what the blurred shape lacks there to the cut (the energy's linear model), and is worth the
    number of views in which it lies on a ray that misses.

    Args:
        rays: all of them meet `cap`.
        u: (X, Y, Z) float32, the shape; given voxels become 1.
        cap: (X, Y, Z) uint8, 1 where the shape may be.
        blurred: (X, Y, Z) float32.
        cut: level at which the blurred shape is cut.
        ball: radius, voxels; below 1 it is the voxel alone.

    Returns:
        How many rays missed.
    """
    state = find_met(rays, (u > 0.5).view(np.uint8))
    missed = np.flatnonzero(state[rays.squares] == _MISSED)
    chosen = np.empty(len(missed), np.int64)
    lines = (rays.origins, rays.directions, rays.views, rays.projections, rays.sizes, rays.starts)
    parallel_for(_choose, len(missed), 64, missed, *lines, cap, blurred, cut, state, chosen)
    _fill_balls(np.unique(chosen[chosen >= 0]), ball, cap, u)
    return len(missed)
