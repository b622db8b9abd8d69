"""The march of rays through a hull's bricks on CUDA as one Triton kernel. Imported only where it is used.

Its twin is the loop in torch, `raycast.march_with_torch`: the same steps in the same arithmetic, but a
program walks its rays to their end, so that a call is one launch and the host waits for nothing.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

RAYS = 128
"""Rays per program; they walk until the last of them has ended."""


@triton.jit
def _out(o, d, low, high):
    """t at which a ray leaves a box along one axis; never, along an axis on which it stands still."""
    plane = tl.where(d > 0, high, low).to(tl.float64)
    return tl.where(d == 0, float("inf"), (plane - o) / tl.where(d == 0, 1.0, d))


@triton.jit
def _next(o, d, t, out, plane, low, high):
    """Voxel of a ray that has left a box, along one axis: beyond its plane, or what rounding keeps in the box."""
    inside = tl.minimum(tl.maximum(tl.floor(o + t * d), low.to(tl.float64)), (high - 1).to(tl.float64)).to(
        tl.int32
    )
    return tl.where(plane == out, tl.where(d > 0, high, low - 1), inside)


@triton.jit
def _start(o, d, t, size):
    return tl.minimum(tl.maximum(tl.floor(o + t * d), 0.0), (size - 1) * 1.0).to(tl.int32)


@triton.jit
def _march(
    origins, directions, begins, ends, alive, found, grid, distance, count, nx, ny, nz, RAYS: tl.constexpr
):
    at = tl.program_id(0) * RAYS + tl.arange(0, RAYS)
    live = at < count
    on = live & (tl.load(alive + at, live, 0) != 0)
    ox, oy, oz = (
        tl.load(origins + 3 * at, on, 0.0),
        tl.load(origins + 3 * at + 1, on, 0.0),
        tl.load(origins + 3 * at + 2, on, 0.0),
    )
    dx, dy, dz = (
        tl.load(directions + 3 * at, on, 0.0),
        tl.load(directions + 3 * at + 1, on, 0.0),
        tl.load(directions + 3 * at + 2, on, 0.0),
    )
    t, end = tl.load(begins + at, on, 0.0), tl.load(ends + at, on, 0.0)
    met = tl.full((RAYS,), -1.0, tl.float64)
    x, y, z = _start(ox, dx, t, nx), _start(oy, dy, t, ny), _start(oz, dz, t, nz)
    bricks_y, bricks_z = (ny + 3) // 4, (nz + 3) // 4
    while tl.sum(on.to(tl.int32), 0) > 0:
        a, b, c = x // 4, y // 4, z // 4
        free = tl.load(distance + (a * bricks_y + b).to(tl.int64) * bricks_z + c, on, 1).to(tl.int32)
        single = free == 0
        full = tl.load(grid + (x.to(tl.int64) * ny + y) * nz + z, on & single, 0)
        stop = on & single & (full != 0)
        met = tl.where(stop, t, met)
        # The empty cube around the voxel: of bricks, or the voxel alone in a brick that holds something.
        x0, x1 = tl.where(single, x, 4 * (a - free + 1)), tl.where(single, x + 1, 4 * (a + free))
        y0, y1 = tl.where(single, y, 4 * (b - free + 1)), tl.where(single, y + 1, 4 * (b + free))
        z0, z1 = tl.where(single, z, 4 * (c - free + 1)), tl.where(single, z + 1, 4 * (c + free))
        tx, ty, tz = _out(ox, dx, x0, x1), _out(oy, dy, y0, y1), _out(oz, dz, z0, z1)
        out = tl.minimum(tl.minimum(tx, ty), tz)
        t = tl.where(on & (out > t), out, t)
        x = tl.where(on, _next(ox, dx, t, out, tx, x0, x1), x)
        y = tl.where(on, _next(oy, dy, t, out, ty, y0, y1), y)
        z = tl.where(on, _next(oz, dz, t, out, tz, z0, z1), z)
        on = on & (stop == 0) & (t < end)
        on = on & (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    tl.store(found + at, met, live)


def march(
    origins: Tensor,
    directions: Tensor,
    begin: Tensor,
    end: Tensor,
    alive: Tensor,
    grid: Tensor,
    distance: Tensor,
) -> Tensor:
    """t at which rays first are in an occupied voxel, -1 where they never are.

    Args:
        origins, directions: (N, 3) float64 in units of voxels, from the grid's lower corner.
        begin, end: (N,) float64, where on the rays to look.
        alive: (N,) bool; the others are misses.
        grid: (X, Y, Z) bool occupancy on the rays' device.
        distance: (A, B, C) uint8, in bricks of 4 voxels, edge of the empty cube around each in all directions.
    """
    found = torch.empty_like(begin)
    count = len(begin)
    if count:
        flags = (alive.view(torch.uint8), grid.contiguous().view(torch.uint8))
        _march[(triton.cdiv(count, RAYS),)](
            origins.contiguous(), directions.contiguous(), begin.contiguous(), end.contiguous(), flags[0], found,
            flags[1], distance.contiguous(), count, *grid.shape, RAYS=RAYS,
        )  # fmt: skip
    return found
