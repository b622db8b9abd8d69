"""Where rays enter and leave a hull, and what a camera sees of it: voxel traversal, without a mesh.

The grid is cut into bricks of 4 x 4 x 4 voxels, 64 bits each, with the distance (largest difference over the
axes, in bricks) from every brick to the nearest one that holds anything. Empty space is crossed in cubes of that
size (after sphere tracing in distance fields); inside a brick that holds something the ray steps from voxel to
voxel (Amanatides and Woo 1987). Crossings are exact: t at the plane between two voxels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from visdom_plugin.cameras import Cameras
from visdom_plugin.hull.hull import Hull, occupied_box

_BRICK = 4
_FARTHEST = 255


class Crossing(NamedTuple):
    """Where rays meet a hull."""

    t_first: Tensor
    """(...) first entry, in units of the direction's length; 0 for an origin inside and for a miss."""
    t_last: Tensor
    """(...) last exit, same unit; 0 for a miss."""
    hit: Tensor
    """(...) bool."""


class Bricks(NamedTuple):
    """An occupancy grid in bricks."""

    bits: np.ndarray
    """(A, B, C) uint64, bit x + 4 y + 16 z of a brick is voxel (x, y, z) in it."""
    distance: np.ndarray
    """(A, B, C) uint8 distance to the nearest brick that is not empty, in bricks, at most 255."""


@njit(cache=True, nogil=True, parallel=True)
def _pack(grid, bits, distance):
    nx, ny, nz = grid.shape
    for a in prange(bits.shape[0]):
        for x in range(4 * a, min(4 * a + 4, nx)):
            for y in range(ny):
                base = (x & 3) + 4 * (y & 3)
                for z in range(nz):
                    if grid[x, y, z]:
                        bits[a, y >> 2, z >> 2] |= np.uint64(1) << np.uint64(base + 16 * (z & 3))
        for b in range(bits.shape[1]):
            for c in range(bits.shape[2]):
                distance[a, b, c] = 0 if bits[a, b, c] else _FARTHEST


@njit(cache=True, nogil=True)
def _spread(distance, order):
    """One sweep of the chessboard distance transform (Rosenfeld and Pfaltz 1968); two sweeps are exact."""
    na, nb, nc = distance.shape
    for p in range(na):
        a = p if order > 0 else na - 1 - p
        for q in range(nb):
            b = q if order > 0 else nb - 1 - q
            for r in range(nc):
                c = r if order > 0 else nc - 1 - r
                best = np.int64(distance[a, b, c])
                for n in range(13):
                    i = a - order if n < 9 else a
                    j = b + n // 3 - 1 if n < 9 else (b - order if n < 12 else b)
                    k = c + n % 3 - 1 if n < 12 else c - order
                    if 0 <= i < na and 0 <= j < nb and 0 <= k < nc:
                        best = min(best, np.int64(distance[i, j, k]) + 1)
                distance[a, b, c] = best


def build_bricks(occupancy: np.ndarray) -> Bricks:
    """Bricks of an (X, Y, Z) bool grid."""
    shape = tuple(-(-n // _BRICK) for n in occupancy.shape)
    bits, distance = np.zeros(shape, np.uint64), np.empty(shape, np.uint8)
    _pack(occupancy.view(np.uint8), bits, distance)
    _spread(distance, 1)
    _spread(distance, -1)
    return Bricks(bits, distance)


@njit(cache=True, nogil=True, inline="always")
def _slope(d):
    """Inverse, constant, step, next plane of a voxel: t at plane p is (p - o) * inverse + constant."""
    if d > 0:
        return 1.0 / d, 0.0, 1, 1
    if d < 0:
        return 1.0 / d, 0.0, -1, 0
    return 0.0, np.inf, 0, 1


@njit(cache=True, nogil=True, inline="always")
def _within(value, low, high):
    # Inside the grid no value is below zero, so cutting off the fraction is the floor.
    index = np.int64(value)
    index = index if index > low else low
    return index if index < high else high


@njit(cache=True, nogil=True)
def _first_hit(ox, oy, oz, dx, dy, dz, begin, end, nx, ny, nz, bits, distance):
    """Smallest t in [begin, end) at which the ray is in an occupied voxel; -1 without one. Units of voxels."""
    ix, cx, sx, px = _slope(dx)
    iy, cy, sy, py = _slope(dy)
    iz, cz, sz, pz = _slope(dz)
    t = begin
    x, y, z = (
        _within(ox + t * dx, 0, nx - 1),
        _within(oy + t * dy, 0, ny - 1),
        _within(oz + t * dz, 0, nz - 1),
    )
    while True:
        a, b, c = x >> 2, y >> 2, z >> 2
        free = np.int64(distance[a, b, c])
        if free == 0:
            # Voxel by voxel to the end of this brick, without branches on the axis.
            word = bits[a, b, c]
            tx, ty, tz = (x + px - ox) * ix + cx, (y + py - oy) * iy + cy, (z + pz - oz) * iz + cz
            while True:
                if word >> np.uint64((x & 3) | (y & 3) << 2 | (z & 3) << 4) & np.uint64(1):
                    return t
                out = tx if tx < ty else ty
                out = out if out < tz else tz
                on_x = np.int64(tx == out)
                on_y = np.int64(ty == out) & (1 - on_x)
                on_z = 1 - on_x - on_y
                x, y, z = x + sx * on_x, y + sy * on_y, z + sz * on_z
                tx, ty, tz = (x + px - ox) * ix + cx, (y + py - oy) * iy + cy, (z + pz - oz) * iz + cz
                t = out if out > t else t
                if ((x >> 2) ^ a) | ((y >> 2) ^ b) | ((z >> 2) ^ c):
                    break
        else:
            # All bricks nearer than `free` are empty: leave their cube at once.
            x0, x1 = (a - free + 1) << 2, (a + free) << 2
            y0, y1 = (b - free + 1) << 2, (b + free) << 2
            z0, z1 = (c - free + 1) << 2, (c + free) << 2
            tx = ((x1 if px else x0) - ox) * ix + cx
            ty = ((y1 if py else y0) - oy) * iy + cy
            tz = ((z1 if pz else z0) - oz) * iz + cz
            out = tx if tx < ty else ty
            out = out if out < tz else tz
            t = out if out > t else t
            # The axis that leaves goes exactly one past the cube; rounding must not push the others out of it.
            x = _within(ox + t * dx, x0, x1 - 1)
            y = _within(oy + t * dy, y0, y1 - 1)
            z = _within(oz + t * dz, z0, z1 - 1)
            x = (x1 if px else x0 - 1) if tx == out else x
            y = (y1 if py else y0 - 1) if ty == out else y
            z = (z1 if pz else z0 - 1) if tz == out else z
        if t >= end or x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
            return -1.0


@njit(cache=True, nogil=True, inline="always")
def _clip_axis(o, d, low, high, near, far):
    if d == 0:
        return (near, far) if low <= o < high else (1.0, 0.0)
    inverse = 1.0 / d
    t0, t1 = (low - o) * inverse, (high - o) * inverse
    t0, t1 = (t0, t1) if t0 < t1 else (t1, t0)
    return t0 if t0 > near else near, t1 if t1 < far else far


@njit(cache=True, nogil=True, parallel=True)
def _cast(origins, directions, lower, scale, box, shape, bits, distance, both, first, last, hit):
    # One origin may serve all rays of a camera.
    step = 0 if len(origins) == 1 else 1
    nx, ny, nz = shape
    for r in prange(len(directions)):
        o, d = origins[r * step], directions[r]
        ox, oy, oz = (o[0] - lower[0]) * scale[0], (o[1] - lower[1]) * scale[1], (o[2] - lower[2]) * scale[2]
        dx, dy, dz = d[0] * scale[0], d[1] * scale[1], d[2] * scale[2]
        first[r], last[r], hit[r] = 0, 0, False
        # Also rejects NaN.
        if not (dx * dx + dy * dy + dz * dz > 0 and abs(ox) + abs(oy) + abs(oz) < np.inf):
            continue
        near, far = _clip_axis(ox, dx, box[0, 0], box[1, 0], 0.0, np.inf)
        near, far = _clip_axis(oy, dy, box[0, 1], box[1, 1], near, far)
        near, far = _clip_axis(oz, dz, box[0, 2], box[1, 2], near, far)
        if not near < far:
            continue
        t = _first_hit(ox, oy, oz, dx, dy, dz, near, far, nx, ny, nz, bits, distance)
        if t < 0:
            continue
        first[r], hit[r] = t, True
        if both:
            # The last exit is the first hit from the other end. Rounding may lose a ray that grazes an edge.
            px, py, pz = ox + far * dx, oy + far * dy, oz + far * dz
            back = _first_hit(px, py, pz, -dx, -dy, -dz, 0.0, far - t, nx, ny, nz, bits, distance)
            last[r] = far - back if back >= 0 else t


def cast(hull: Hull, origins, directions) -> Crossing:
    """First entry into and last exit from the occupied voxels, exact to rounding.

    On the CPU numba walks the voxels, on CUDA `march` does it in torch.

    Args:
        origins, directions: (..., 3) tensors or arrays, broadcast against each other; world frame; directions of
            any length but zero.

    Returns:
        Crossing in the rays' dtype (float64 for numpy input), on their device; tensors, without gradient.
    """
    origins, directions = (torch.as_tensor(x).detach() for x in (origins, directions))
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    dtype = directions.dtype if directions.is_floating_point() else torch.float64
    if directions.device.type != "cpu":
        first, last, hit = march(hull, origins, directions)
        return Crossing(first.to(dtype), last.to(dtype), hit)
    first, last, hit = _walk(hull, origins, directions, shape, both=True)
    return Crossing(first.to(dtype), last.to(dtype), hit)


def _walk(hull: Hull, origins: Tensor, directions: Tensor, shape, *, both: bool):
    origins = origins.reshape(1, 3) if origins.numel() == 3 else origins.expand(*shape, 3).reshape(-1, 3)
    directions = directions.expand(*shape, 3).reshape(-1, 3)
    if directions.dtype != torch.float32 or origins.dtype != torch.float32:
        directions, origins = directions.double(), origins.double()
    directions, origins = directions.contiguous().numpy(), origins.contiguous().numpy()
    bricks = hull._once("bricks", lambda: build_bricks(hull.occupancy))
    first, last = np.empty(len(directions)), np.empty(len(directions))
    hit = np.empty(len(directions), np.bool_)
    lower, scale = np.ascontiguousarray(hull.bounds[0]), 1 / hull.voxel_edges
    box = hull._once("box", lambda: occupied_box(hull.occupancy).astype(float))
    _cast(origins, directions, lower, scale, box, np.array(hull.shape), *bricks, both, first, last, hit)
    return tuple(torch.from_numpy(x).reshape(shape) for x in (first, last, hit))


def march(hull: Hull, origins: Tensor, directions: Tensor) -> Crossing:
    """`cast` in torch on the rays' device: all rays advance together through the brick distances.

    Same arguments and result as `cast`, in float64.
    """
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    device = directions.device
    lower, edges = (torch.as_tensor(x, device=device) for x in (hull.bounds[0], hull.voxel_edges))
    o = ((origins.detach().double() - lower) / edges).expand(*shape, 3).reshape(-1, 3)
    d = (directions.detach().double() / edges).expand(*shape, 3).reshape(-1, 3)
    low, high = torch.as_tensor(occupied_box(hull.occupancy), device=device)
    planes = torch.stack([(low - o) / d, (high - o) / d])
    within = (o >= low) & (o < high)
    planes = torch.where(d == 0, torch.where(within, torch.inf, torch.nan), planes)
    near = torch.where(d == 0, -planes[0], planes.amin(0)).amax(-1).clamp_min(0)
    far = planes.amax(0).amin(-1)
    alive = (near < far) & (d.square().sum(-1) > 0) & torch.isfinite(far)
    first = _march_ahead(hull, o, d, near, far, alive)
    hit = first >= 0
    end = torch.where(hit, far, 0.0)[:, None]
    back = _march_ahead(hull, o + end * d, -d, torch.zeros_like(far), far - first, hit)
    last = torch.where(back >= 0, far - back, first)
    results = (torch.where(hit, first, 0.0), torch.where(hit, last, 0.0), hit)
    return Crossing(*(x.reshape(shape) for x in results))


def _march_ahead(hull: Hull, o: Tensor, d: Tensor, begin: Tensor, end: Tensor, alive: Tensor) -> Tensor:
    bricks = hull._once("bricks", lambda: build_bricks(hull.occupancy))
    device = o.device
    distance = hull._once(("distance", str(device)), lambda: torch.from_numpy(bricks.distance).to(device))
    grid = hull._grid_on(device)
    size = torch.tensor(hull.shape, device=device)
    found = torch.full_like(begin, -1.0)
    rays = alive.nonzero()[:, 0]
    o, d, t, end = o[rays], d[rays], begin[rays], end[rays]
    voxel = torch.floor(o + t[:, None] * d).long().clamp_min(0).minimum(size - 1)
    while len(rays):
        brick = voxel // _BRICK
        free = distance[tuple(brick.T)].long()
        stop = (free == 0) & grid[tuple(voxel.T)]
        found[rays[stop]] = t[stop]
        # The empty cube around the voxel: of bricks, or the voxel alone in a brick that holds something.
        single = (free == 0)[:, None]
        low = torch.where(single, voxel, _BRICK * (brick - free[:, None] + 1))
        high = torch.where(single, voxel + 1, _BRICK * (brick + free[:, None]))
        planes = torch.where(d == 0, torch.inf, (torch.where(d > 0, high, low) - o) / d)
        out = planes.amin(-1)
        t = torch.maximum(t, out)
        inside = torch.floor(o + t[:, None] * d).long().maximum(low).minimum(high - 1)
        voxel = torch.where(planes == out[:, None], torch.where(d > 0, high, low - 1), inside)
        on = ~stop & (t < end) & ((voxel >= 0) & (voxel < size)).all(-1)
        rays, o, d, t, end, voxel = (x[on] for x in (rays, o, d, t, end, voxel))
    return found


def depth_and_silhouette(hull: Hull, camera: Cameras) -> tuple[Tensor, Tensor]:
    """What one camera sees of the hull.

    Args:
        camera: one camera, shape ().

    Returns:
        depth (H, W) float32 along the camera's z axis in scene units, 0 beside the hull; and mask (H, W) bool,
        True where the ray through the pixel's centre meets the hull. On the camera's device.
    """
    K, motion = camera.intrinsics.double(), camera.world_from_camera.double()
    height, width = int(camera.height), int(camera.width)
    columns = torch.arange(width, dtype=torch.float64, device=K.device) + 0.5
    rows = torch.arange(height, dtype=torch.float64, device=K.device) + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    # Directions of camera depth 1, so that t is the depth along z.
    right, down, ahead = motion[:3, 0], motion[:3, 1], motion[:3, 2]
    directions = x[:, None] * right + (y[:, None] * down + ahead)[:, None, :]
    origin = motion[:3, 3]
    if directions.device.type != "cpu":
        crossing = march(hull, origin, directions)
        return crossing.t_first.float(), crossing.hit
    first, _, hit = _walk(hull, origin, directions, (height, width), both=False)
    return first.float(), hit
