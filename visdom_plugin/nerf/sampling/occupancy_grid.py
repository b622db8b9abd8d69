"""A grid of where there may be density, so that empty space is not sampled (Müller et al. 2022, appendix E)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.seeding import draw_on, uniform

ROUNDING = -1e-3
"""In cells: rays that are cut to the cube end on its faces, and rounding puts their ends up to about 1e-4 outside.
So little below a lower face still is the first cell."""


class PackedSamples(NamedTuple):
    """Intervals of all rays, one ray after the other."""

    ray_offsets: Tensor
    """(n + 1,) int64; samples of ray r are ray_offsets[r] .. ray_offsets[r + 1]."""
    ray: Tensor
    """(M,) int64 ray of each sample."""
    starts: Tensor
    """(M,) float32 along the ray."""
    ends: Tensor
    """(M,) float32."""


class OccupancyGrid:
    """Density seen in the cells of a cube [-half_side, half_side]^3, decaying, and the cells worth sampling.

    Args:
        resolution: cells along each axis.
        half_side: of the cube.
        threshold: a cell is occupied above min(threshold, mean over the cells).
        decay: of the remembered density at every update.
    """

    def __init__(
        self,
        resolution: int,
        half_side: float,
        threshold: float,
        decay: float = 0.95,
        device: torch.device | str = "cpu",
    ):
        self.resolution, self.half_side = resolution, half_side
        self.threshold, self.decay = threshold, decay
        self.density = torch.zeros(resolution**3, device=device)
        self.reachable = torch.ones(resolution, resolution, resolution, dtype=torch.bool, device=device)
        self.occupied = self.reachable.clone()

    @torch.no_grad()
    def update(
        self, density_of: Callable[[Tensor], Tensor], generator: Generator, *, fraction: float
    ) -> None:
        """Looks at some cells again: density <- max(decay * density, density at a random point of the cell).

        Args:
            density_of: points (m, 3) to density (m,).
            generator: on the CPU.
            fraction: 1 looks at every cell; less looks at this share of all cells drawn evenly, and at as many
                of the occupied ones.
        """
        count = self.resolution**3
        device = self.density.device
        draw = draw_on(device, generator)
        if fraction >= 1:
            cells = torch.arange(count, device=device)
        else:
            n = max(1, int(fraction * count))
            cells = torch.randint(count, (n,), generator=draw, device=draw.device).to(device)
            occupied = self.occupied.flatten().nonzero()[:, 0]
            if len(occupied):
                drawn = torch.randint(len(occupied), (n,), generator=draw, device=draw.device)
                cells = torch.cat([cells, occupied[drawn.to(device)]])
        index = torch.stack(
            [
                cells // self.resolution**2,
                cells // self.resolution % self.resolution,
                cells % self.resolution,
            ],
            -1,
        )
        within = uniform(draw, device, len(cells), 3)
        points = ((index + within) * (2 / self.resolution) - 1) * self.half_side
        found = density_of(points).float()
        self.density *= self.decay
        # The same cell may be drawn twice: the larger density counts, whatever the order.
        self.density.scatter_reduce_(0, cells, found, "amax")
        self.occupied = self._above(self.threshold)

    def loosened(self, threshold: float) -> OccupancyGrid:
        """This grid with the cells above a smaller threshold, too, to march through; the density is shared."""
        grid = copy.copy(self)
        grid.threshold, grid.occupied = threshold, self.occupied | self._above(threshold)
        return grid

    def _above(self, threshold: float) -> Tensor:
        limit = self.density.double().mean().clamp_max(threshold)
        return (self.density > limit).reshape(self.reachable.shape) & self.reachable

    def restrict(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> None:
        """Gives up all cells that no training ray samples, but for neighbours of those that one does.

        What no ray ever samples is never trained: whatever the field says there is made up. Instant-NGP gives
        up cells that no training camera sees, for the same reason.

        Args:
            origins, directions: (n, 3) float32, the training rays or an even choice of them.
            near, far: (n,) float32 their bounds.
        """
        grid = torch.zeros(self.reachable.shape, dtype=torch.bool)
        o, d, low, high = (
            x.detach().float().cpu().contiguous().numpy() for x in (origins, directions, near, far)
        )
        half_cell = np.float32(self.half_side / self.resolution)
        _touch(o, d, low, high, half_cell, grid.numpy(), np.float32(self.half_side))
        grown = torch.nn.functional.max_pool3d(grid[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
        self.reachable = grown.to(self.reachable.device)
        self.occupied = self.occupied & self.reachable

    def is_occupied(self, points: Tensor) -> Tensor:
        """(...) bool of points (..., 3); False outside the cube."""
        n = self.resolution
        cell = ((points + self.half_side) * (n / (2 * self.half_side))).floor().long()
        x, y, z = cell.clamp(0, n - 1).unbind(-1)
        return ((cell >= 0) & (cell < n)).all(-1) & self.occupied[x, y, z]

    def state_dict(self) -> dict[str, Tensor]:
        return {"density": self.density, "occupied": self.occupied.to(torch.uint8)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.density = state["density"].to(self.density.device).clone()
        self.occupied = state["occupied"].to(self.density.device).bool()


def intersect_cube(origins: Tensor, directions: Tensor, half_side: float) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the cube [-half_side, half_side]^3.

    Args:
        origins, directions: (..., 3).

    Returns:
        (...) entry, at least 0, and exit; entry >= exit for rays that miss.
    """
    # A zero component divides to +-inf, which min and max treat rightly; 0 / 0, on a face, is left to the others.
    inverse = 1 / directions
    t0, t1 = (-half_side - origins) * inverse, (half_side - origins) * inverse
    enter = torch.minimum(t0, t1).nan_to_num(nan=-torch.inf, posinf=torch.inf, neginf=-torch.inf)
    leave = torch.maximum(t0, t1).nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)
    return enter.amax(-1).clamp_min(0), leave.amin(-1)


@kernel(error_model="numpy")
def _count(begin, end, origins, directions, near, far, step, shift, occupied, half_side, counts, marks):
    """How many samples each ray takes, and a bit for each place along it, set where it takes one."""
    n = occupied.shape[0]
    scale = n / (2 * half_side)
    for r in range(begin, end):
        ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        found, i, word = 0, 0, np.uint64(0)
        while True:
            middle = near[r] + (i + shift[r]) * step[r] + np.float32(0.5) * step[r]
            if not middle < far[r]:
                break
            x = (ox + middle * dx + half_side) * scale
            y = (oy + middle * dy + half_side) * scale
            z = (oz + middle * dz + half_side) * scale
            if (
                ROUNDING < x < n
                and ROUNDING < y < n
                and ROUNDING < z < n
                and occupied[int(x), int(y), int(z)]
            ):
                word |= np.uint64(1) << np.uint64(i & 63)
                found += 1
            i += 1
            if i & 63 == 0:
                marks[r, (i >> 6) - 1], word = word, np.uint64(0)
        if i & 63 != 0:
            marks[r, i >> 6] = word
        counts[r] = found


@kernel(error_model="numpy")
def _fill(begin, end, near, step, shift, offsets, marks, starts, ends, rays):
    for r in range(begin, end):
        at, i = offsets[r], 0
        while at < offsets[r + 1]:
            if marks[r, i >> 6] >> np.uint64(i & 63) & np.uint64(1) != 0:
                starts[at] = near[r] + (i + shift[r]) * step[r]
                ends[at] = starts[at] + step[r]
                rays[at] = r
                at += 1
            i += 1


@kernel()
def _touch(origins, directions, near, far, step, touched, half_side):
    n = touched.shape[0]
    scale = n / (2 * half_side)
    for r in range(len(origins)):
        t = near[r]
        while t < far[r]:
            x = (origins[r, 0] + t * directions[r, 0] + half_side) * scale
            y = (origins[r, 1] + t * directions[r, 1] + half_side) * scale
            z = (origins[r, 2] + t * directions[r, 2] + half_side) * scale
            if ROUNDING < x < n and ROUNDING < y < n and ROUNDING < z < n:
                touched[int(x), int(y), int(z)] = True
            t += step


def march_occupied(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    step: Tensor,
    shift: Tensor,
    grid: OccupancyGrid,
) -> PackedSamples:
    """Samples at regular distances along each ray, where the grid is occupied.

    Interval i of a ray is [near + (i + shift) step, near + (i + 1 + shift) step]; it is taken when its middle
    lies before far and in an occupied cell.

    Args:
        origins, directions: (n, 3) float32 in the grid's frame.
        near, far, step: (n,) float32 along the ray; step > 0.
        shift: (n,) in [0, 1), the jitter.
    """
    if origins.device.type != "cpu":
        return _march_torch(origins, directions, near, far, step, shift, grid)
    rays = [x.detach().float().contiguous().numpy() for x in (origins, directions, near, far, step, shift)]
    counts = np.empty(len(origins), np.int64)
    longest = np.nan_to_num((rays[3] - rays[2]) / rays[4]).max(initial=0)
    marks = np.empty((len(origins), int(longest) // 64 + 2), np.uint64)
    parallel_for(
        _count, len(origins), 128, *rays, grid.occupied.numpy(), np.float32(grid.half_side), counts, marks
    )
    offsets = np.concatenate([[0], np.cumsum(counts)])
    starts, ends = np.empty(offsets[-1], np.float32), np.empty(offsets[-1], np.float32)
    ray = np.empty(offsets[-1], np.int64)
    parallel_for(_fill, len(origins), 128, *rays[2:3], *rays[4:], offsets, marks, starts, ends, ray)
    return PackedSamples(*map(torch.from_numpy, (offsets, ray, starts, ends)))


def middles_of(origins: Tensor, directions: Tensor, samples: PackedSamples) -> Tensor:
    """(M, 3) points in the middle of each interval, of rays (n, 3); as they are, without gradient on the CPU."""
    if origins.device.type != "cpu":
        return _middles_torch(origins, directions, samples)
    arrays = [x.detach().contiguous().numpy() for x in (origins, directions, *samples[1:])]
    out = np.empty((len(samples.ray), 3), np.float32)
    parallel_for(find_middles, len(out), 8192, *arrays, out)
    return torch.from_numpy(out)


def _middles_torch(origins: Tensor, directions: Tensor, samples: PackedSamples) -> Tensor:
    middles = (samples.starts + samples.ends) / 2
    return origins[samples.ray] + middles[:, None] * directions[samples.ray]


@kernel(error_model="numpy")
def find_middles(begin, end, origins, directions, ray, starts, ends, out):
    for i in range(begin, end):
        middle, r = (starts[i] + ends[i]) / np.float32(2), ray[i]
        for axis in range(3):
            out[i, axis] = origins[r, axis] + middle * directions[r, axis]


def select(samples: PackedSamples, kept: Tensor) -> PackedSamples:
    """The samples with `kept` (M,) bool; rays may be left without any."""
    before = torch.cat([samples.ray_offsets.new_zeros(1), kept.long().cumsum(0)])
    return PackedSamples(
        before[samples.ray_offsets], samples.ray[kept], samples.starts[kept], samples.ends[kept]
    )


def _march_torch(origins, directions, near, far, step, shift, grid: OccupancyGrid) -> PackedSamples:
    most = int(((far - near) / step).clamp_min(0).max().ceil()) + 1 if len(origins) else 0
    index = torch.arange(most, device=origins.device)
    starts = near[:, None] + (index + shift[:, None]) * step[:, None]
    middles = starts + 0.5 * step[:, None]
    points = origins[:, None] + middles[..., None] * directions[:, None]
    taken = (middles < far[:, None]) & grid.is_occupied(points)
    ray, which = taken.nonzero(as_tuple=True)
    offsets = torch.cat([ray.new_zeros(1), taken.sum(1).cumsum(0)])
    return PackedSamples(offsets, ray, starts[ray, which], starts[ray, which] + step[ray])
