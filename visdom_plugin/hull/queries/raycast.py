"""Where rays enter and leave a hull, and what a camera sees of it: voxel traversal, without a mesh.

Empty space is crossed in the cubes of bricks that `bricks` looked up ahead (after sphere tracing in distance
fields); inside a brick that holds something the ray crosses empty blocks of 2 x 2 x 2
voxels, and goes from voxel to voxel (Amanatides and Woo 1987). Crossings are exact: t at the plane between voxels.

A step of any kind leaves a box by the same arithmetic, without a branch, in a grid mirrored so that no ray goes
back. On the CPU rays walk in packs, each ray of a pack one step per round: what one step waits for the next ray's
step fills, and no wrongly guessed branch throws work away.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull, occupied_box
from visdom_plugin.hull.queries.bricks import BRICK, build_bricks

_PACK = 256
"""Rays that walk together; their state, 30 KiB, stays in the first cache."""
_GRAIN = 16 * _PACK
_EIGHTH, _EVEN = np.uint64(0x330033), np.uint64(0b101010)
"""Bits of the first 2 x 2 x 2 voxels of a brick; bits of a place that count in steps of two."""
_NEVER = 1e300
"""Inverse of a direction of zero: its planes are never reached."""


class Crossing(NamedTuple):
    """Where rays meet a hull."""

    t_first: Tensor
    """(...) first entry, in units of the direction's length; 0 for an origin inside and for a miss."""
    t_last: Tensor
    """(...) last exit, same unit; 0 for a miss."""
    hit: Tensor
    """(...) bool."""


@kernel()
def _walk_pack(
    count: int, rays: np.ndarray, turns: np.ndarray, hit: np.ndarray, active: np.ndarray, size: np.ndarray,
    bits: np.ndarray, ahead: np.ndarray,
) -> None:  # fmt: skip
    """Finds where rays first are in an occupied voxel, in a grid turned so that none goes back; units of voxels.

    Args:
        count: rays in the pack.
        rays: (P, 14) float64: origin, direction, inverse of the direction, a point in the voxel where the ray is,
            t of that point, and t at the end.
        turns: (P, 6) int64: index of a brick from its turned place (factor for each axis, and offset), bits that
            turn a place inside a brick, and where the octant of `ahead` starts.
        hit: (P,) bool, comes out: whether the walk ended in an occupied voxel, at the t that is left in `rays`.
        active: (P,) uint64, room to work in.
        size: (3,) float64 voxels of the grid in whole bricks.
        bits, ahead: flat.
    """
    for n in range(count):
        active[n] = n
    while count > 0:
        kept = 0
        for n in range(count):
            r = active[n]
            px, py, pz, begin = rays[r, 9], rays[r, 10], rays[r, 11], rays[r, 12]
            x, y, z = np.int64(px), np.int64(py), np.int64(pz)
            brick = turns[r, 3] + (x >> 2) * turns[r, 0] + (y >> 2) * turns[r, 1] + (z >> 2) * turns[r, 2]
            free = np.int64(ahead[np.uint64(brick + turns[r, 5])])
            word = bits[np.uint64(brick)]
            at = np.uint64(((x & 3) | (y & 3) << 2 | (z & 3) << 4) ^ turns[r, 4])
            full = (word >> at) & np.uint64(1) != 0
            # Leave the empty cube of bricks ahead, or the empty 2 x 2 x 2 voxels, or the voxel.
            eighth = word & (_EIGHTH << (at & _EVEN))
            shift, near = np.int64(free != 0) + np.int64(eighth == 0), free + np.int64(free == 0)
            x1, y1, z1 = (
                float(((x >> shift) + near) << shift),
                float(((y >> shift) + near) << shift),
                float(((z >> shift) + near) << shift),
            )
            ox, oy, oz = rays[r, 0], rays[r, 1], rays[r, 2]
            tx, ty, tz = (x1 - ox) * rays[r, 6], (y1 - oy) * rays[r, 7], (z1 - oz) * rays[r, 8]
            out = tx if tx < ty else ty
            out = out if out < tz else tz
            t = out if out > begin else begin
            # The axis that leaves goes exactly to the plane; rounding must not push the others over theirs.
            qx, qy, qz = ox + t * rays[r, 3], oy + t * rays[r, 4], oz + t * rays[r, 5]
            qx, qy, qz = qx if qx > px else px, qy if qy > py else py, qz if qz > pz else pz
            qx = qx if qx < x1 - 0.5 else x1 - 0.5
            qy = qy if qy < y1 - 0.5 else y1 - 0.5
            qz = qz if qz < z1 - 0.5 else z1 - 0.5
            qx, qy, qz = x1 if tx == out else qx, y1 if ty == out else qy, z1 if tz == out else qz
            hit[r] = full
            rays[r, 9], rays[r, 10], rays[r, 11] = qx, qy, qz
            rays[r, 12] = begin if full else t
            on = (not full) & (t < rays[r, 13]) & (qx < size[0]) & (qy < size[1]) & (qz < size[2])
            active[kept] = r
            kept += int(on)
        count = kept


@kernel(inline="always")
def _set_out(
    rays: np.ndarray, turns: np.ndarray, n: int, begin: float, end: float, size: np.ndarray,
    shape: np.ndarray,
) -> None:  # fmt: skip
    """Fills in the rest of a ray from its origin and direction in the grid as it is."""
    turns[n, 3], turns[n, 4], octant = 0, 0, 0
    factor = 1
    for b in range(3):
        a = 2 - b
        o, d = rays[n, a], rays[n, 3 + a]
        back = d < 0
        turns[n, a] = -factor if back else factor
        if back:
            o, d = size[a] - o, -d
            turns[n, 3] += factor * (shape[a] - 1)
            turns[n, 4] |= 3 << (2 * a)
            octant |= 1 << a
        factor *= shape[a]
        rays[n, a], rays[n, 3 + a] = o, d
        rays[n, 6 + a] = 1.0 / d if d > 0 else _NEVER
        start = o + begin * d
        start = start if start > 0 else 0.0
        rays[n, 9 + a] = start if start < size[a] - 0.5 else size[a] - 0.5
    turns[n, 5] = octant * factor
    rays[n, 12], rays[n, 13] = begin, end


@kernel(inline="always")
def _clip_axis(o: float, d: float, low: float, high: float, near: float, far: float) -> tuple[float, float]:
    if d == 0:
        return (near, far) if low <= o < high else (1.0, 0.0)
    inverse = 1.0 / d
    t0, t1 = (low - o) * inverse, (high - o) * inverse
    t0, t1 = (t0, t1) if t0 < t1 else (t1, t0)
    return t0 if t0 > near else near, t1 if t1 < far else far


@kernel()
def _cast(
    begin: int, end: int, origins: np.ndarray, directions: np.ndarray, single_origins: np.ndarray,
    single_directions: np.ndarray, lower: np.ndarray, scale: np.ndarray, box: np.ndarray, shape: np.ndarray,
    bits: np.ndarray, ahead: np.ndarray, both: bool, first: np.ndarray, last: np.ndarray, hit: np.ndarray,
) -> None:  # fmt: skip
    # Rays in float64, or else in float32: two pairs of arrays of which one is empty, for one compiled kernel. One
    # origin may serve all rays of a camera.
    single = len(single_directions) > 0
    step = 0 if len(origins) + len(single_origins) == 1 else 1
    zero = 0 * len(shape)  # a mere 0 is a type of its own: the walk would be compiled twice
    size = np.empty(3)
    for a in range(3):
        size[a] = 4.0 * shape[a]
    rays, turns, ends = np.empty((_PACK, 14)), np.empty((_PACK, 6), np.int64), np.empty((_PACK, 7))
    met, active, index = np.empty(_PACK, np.bool_), np.empty(_PACK, np.uint64), np.empty(_PACK, np.int64)
    r = begin
    while r < end:
        count = zero
        while r < end and count < _PACK:
            first[r], last[r], hit[r] = 0, 0, False
            near, far, length, reach = 0.0, np.inf, 0.0, 0.0
            for a in range(3):
                if single:
                    o, d = float(single_origins[r * step, a]), float(single_directions[r, a])
                else:
                    o, d = origins[r * step, a], directions[r, a]
                o, d = (o - lower[a]) * scale[a], d * scale[a]
                near, far = _clip_axis(o, d, box[0, a], box[1, a], near, far)
                length += d * d
                reach += abs(o)
                rays[count, a], rays[count, 3 + a] = o, d
            # Also rejects NaN.
            if near < far and length > 0 and reach < np.inf:
                # The last exit is the first hit from the other end.
                for a in range(3):
                    ends[count, a], ends[count, 3 + a] = (
                        rays[count, a] + far * rays[count, 3 + a],
                        -rays[count, 3 + a],
                    )
                ends[count, 6], index[count] = far, r
                _set_out(rays, turns, count, near, far, size, shape)
                count += 1
            r += 1
        _walk_pack(count, rays, turns, met, active, size, bits, ahead)
        hits = zero
        for n in range(count):
            if met[n]:
                t, far = rays[n, 12], ends[n, 6]
                first[index[n]], hit[index[n]] = t, True
                for a in range(6):  # an assignment of slices takes 2 s to compile
                    rays[hits, a] = ends[n, a]
                ends[hits, 6], index[hits] = far, index[n]
                _set_out(rays, turns, hits, 0.0, far - t, size, shape)
                hits += 1
        if both:
            _walk_pack(hits, rays, turns, met, active, size, bits, ahead)
            for n in range(hits):
                # Rounding may lose a ray that grazes an edge.
                last[index[n]] = ends[n, 6] - rays[n, 12] if met[n] else first[index[n]]


def cast(hull: Hull, origins: Tensor | np.ndarray, directions: Tensor | np.ndarray) -> Crossing:
    """First entry into and last exit from the occupied voxels, exact to rounding.

    On the CPU numba walks the voxels; on CUDA `cast_with_torch` does it, by a Triton kernel where there is Triton.

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
        first, last, hit = cast_with_torch(hull, origins, directions)
    else:
        first, last, hit = _walk(hull, origins, directions, shape, both=True)
    return Crossing(first.to(dtype), last.to(dtype), hit)


def _walk(
    hull: Hull, origins: Tensor, directions: Tensor, shape: tuple[int, ...], *, both: bool
) -> tuple[Tensor, Tensor, Tensor]:
    origins = origins.reshape(1, 3) if origins.numel() == 3 else origins.expand(*shape, 3).reshape(-1, 3)
    directions = directions.expand(*shape, 3).reshape(-1, 3)
    single = directions.dtype == torch.float32 and origins.dtype == torch.float32
    if not single:
        directions, origins = directions.double(), origins.double()
    bricks = hull._once("bricks", lambda: build_bricks(hull.occupancy))
    first, last = np.empty(len(directions)), np.empty(len(directions))
    hit = np.empty(len(directions), np.bool_)
    lower, scale = np.array(hull.bounds[0]), 1 / hull.voxel_edges
    box = hull._once("box", lambda: occupied_box(hull.occupancy).astype(float))
    shaped = (np.array(bricks.bits.shape), bricks.bits.reshape(-1), bricks.ahead.reshape(-1))
    rays = [origins.contiguous().numpy(), directions.contiguous().numpy()]
    others = [np.empty((0, 3), np.float64 if single else np.float32)] * 2
    inputs = (*(others + rays if single else rays + others), lower, scale, box, *shaped, both)
    parallel_for(_cast, len(directions), _GRAIN, *inputs, first, last, hit)
    near, far, met = (torch.from_numpy(x).reshape(shape) for x in (first, last, hit))
    return near, far, met


def cast_with_torch(hull: Hull, origins: Tensor, directions: Tensor) -> Crossing:
    """`cast` in torch on the rays' device: all rays advance together through the brick distances.

    Same arguments and result as `cast`, in float64.
    """
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    device = directions.device
    lower, edges, low, high = hull._once(("frame", str(device)), lambda: _frame_on(hull, device))
    o = ((origins.detach().double() - lower) / edges).expand(*shape, 3).reshape(-1, 3)
    d = (directions.detach().double() / edges).expand(*shape, 3).reshape(-1, 3)
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


def _frame_on(hull: Hull, device: torch.device) -> tuple[Tensor, ...]:
    """Lower corner, edges of a voxel, and the occupied voxels' first and last corner in units of voxels."""
    box = occupied_box(hull.occupancy).astype(float)
    values = np.stack([hull.bounds[0], hull.voxel_edges, *box])
    return tuple(torch.from_numpy(values).to(device))


def _march_ahead(hull: Hull, o: Tensor, d: Tensor, begin: Tensor, end: Tensor, alive: Tensor) -> Tensor:
    bricks = hull._once("bricks", lambda: build_bricks(hull.occupancy))
    device = o.device
    distance = hull._once(("distance", str(device)), lambda: torch.from_numpy(bricks.ahead.min(0)).to(device))
    grid = hull._grid_on(device)
    if device.type == "cuda" and find_spec("triton"):
        from visdom_plugin.hull.queries.march_triton import march

        return march(o, d, begin, end, alive, grid, distance)
    return march_with_torch(o, d, begin, end, alive, grid, distance)


def march_with_torch(
    o: Tensor, d: Tensor, begin: Tensor, end: Tensor, alive: Tensor, grid: Tensor, distance: Tensor
) -> Tensor:
    """Twin of `march_triton.march`, which describes the arguments: one step of all rays at a time."""
    size = torch.tensor(grid.shape, device=o.device)
    found = torch.full_like(begin, -1.0)
    rays = alive.nonzero()[:, 0]
    o, d, t, end = o[rays], d[rays], begin[rays], end[rays]
    voxel = torch.floor(o + t[:, None] * d).long().clamp_min(0).minimum(size - 1)
    while len(rays):
        brick = voxel // BRICK
        free = distance[tuple(brick.T)].long()
        stop = (free == 0) & grid[tuple(voxel.T)]
        found[rays[stop]] = t[stop]
        # The empty cube around the voxel: of bricks, or the voxel alone in a brick that holds something.
        single = (free == 0)[:, None]
        low = torch.where(single, voxel, BRICK * (brick - free[:, None] + 1))
        high = torch.where(single, voxel + 1, BRICK * (brick + free[:, None]))
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
    width, height = camera.size
    columns = torch.arange(width, dtype=torch.float64, device=K.device) + 0.5
    rows = torch.arange(height, dtype=torch.float64, device=K.device) + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    # Directions of camera depth 1, so that t is the depth along z.
    right, down, ahead = motion[:3, 0], motion[:3, 1], motion[:3, 2]
    directions = x[:, None] * right + (y[:, None] * down + ahead)[:, None, :]
    origin = motion[:3, 3]
    if directions.device.type != "cpu":
        crossing = cast_with_torch(hull, origin, directions)
        return crossing.t_first.float(), crossing.hit
    first, _, hit = _walk(hull, origin, directions, (height, width), both=False)
    return first.float(), hit
