"""Bounds of the hull from cameras and masks alone: coarse to fine, without a guess at origin or scale.

The search starts in a cube around the point the cameras look at and judges whole cells, not sample points, so a
part is never lost for being thinner than a cell. Cells that the rule may keep are split in eight.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.hull.carving.areas import Areas
from visdom_plugin.hull.carving.cells import KEPT, MIXED, classify_cells, keep_centres
from visdom_plugin.hull.carving.culling import explaining_pieces
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.carving.votes import Grid, Silhouettes
from visdom_plugin.hull.grid.components import find_pieces, piece_of

log = logging.getLogger(__name__)

_START = 32
"""Cells along a side of the first cube."""
_FINEST = 64
"""Cells along the found box's longest side when the search ends: its faces are known to about 1.5 %."""
_SLACK = 1.2
"""How much longer the box may be than that of the cells whose centres are kept."""
_WIDE = 512
"""Cells across the kept centres at which parts thinner than a cell no longer count."""
_MOST_CELLS, _MOST_EMPTY = 2_000_000, 200_000
"""Cells to judge at once, and as long as no centre is kept."""
_MOST_LABELS = 1 << 24
_MOST_SIDE = 1 << 15
_ENOUGH = 1000
"""Cells inside the region from which its pieces can be compared."""
_DOUBLINGS, _PATIENCE = 3, 2
"""How often the first cube is doubled while it is empty, and while the region touches its faces."""
MARGIN_VOXELS = 2
"""Empty voxels between the region and the faces of the grid."""


class Region(NamedTuple):
    """A box that holds all points the rule may keep."""

    bounds: np.ndarray
    """(2, 3) lower and upper corner, world frame."""
    closed: bool
    """False when the region reaches the limit of the search: the views leave it open."""


class Search(NamedTuple):
    """What a region is searched for."""

    silhouettes: Silhouettes
    areas: Areas
    """From `areas.sum_areas`."""
    rule: KeepRule
    components: str = "all"
    """Which pieces the box must hold: "all"; with "explain" those that explain foreground of their own; with any
    other policy those of not clearly less than `drop_below` of the largest's volume."""
    drop_below: float = 0.0
    effort: float = 1.0
    """Share of the usual number of cells at which the search gives up."""


def find_region(cameras: Cameras, search: Search) -> Region | None:
    """The smallest box known to hold the rule's region, or None when no point can satisfy the rule.

    The first cube reaches twice as far from the look-at point as the farthest camera. The cube is doubled up to
    three times while it holds nothing, and up to twice while the region touches its faces; a region that still
    touches is open, and is clipped to the first cube that holds any of it.
    """
    centre = look_at_point(cameras.to("cpu", dtype=torch.float64)).numpy()
    reach = float((cameras.centres.double().cpu() - torch.from_numpy(centre)).norm(dim=-1).max())
    reach = reach or 1e-6
    first = None
    for doubling in range(_DOUBLINGS + 1):
        half = 2.0 * reach * 2**doubling
        start = Grid(centre - half, 2 * half / _START, (_START,) * 3)
        found = _refine(search, start)
        if found is None:
            continue
        box, touches = found
        if not touches:
            return Region(box, True)
        if first is None:
            first = box
        elif doubling >= _PATIENCE:
            break
    return None if first is None else Region(first, False)


def _refine(search: Search, grid: Grid) -> tuple[np.ndarray, bool] | None:
    """Box of the region inside one cube and whether it touches the cube's faces, or None."""
    silhouettes, areas, rule = search[:3]
    cells = np.stack(np.unravel_index(np.arange(np.prod(grid.shape)), grid.shape), -1)
    settled = np.zeros((0, 3), np.int64)
    while True:
        states = classify_cells(silhouettes, areas, grid, rule, cells)
        mixed = cells[states == MIXED]
        cells = np.concatenate([settled, cells[states == KEPT], mixed])
        inside = np.ones(len(cells), bool)
        whole = len(cells) - len(mixed)
        inside[whole:] = keep_centres(silhouettes, grid, rule, mixed)
        if search.components != "all" and inside.sum() >= _ENOUGH:
            stays = _staying(search, grid, cells, inside)
            whole = int(stays[:whole].sum())
            cells, inside = cells[stays], inside[stays]
        most = search.effort * (_MOST_CELLS if inside.any() else _MOST_EMPTY)
        last = grid.shape[0] >= _MOST_SIDE or 8 * (len(cells) - whole) > most
        # Corners of several frusta stay undecided in cells of any size.
        if len(cells) == 0 or (last and not inside.any()):
            return None
        box = _box_of(cells)
        surely = _box_of(cells[inside]) if inside.any() else None
        across = 0 if surely is None else (surely[1] - surely[0]).max()
        # Slivers where a few frusta meet inflate the box until the cells are small enough to tell.
        tight = (box[1] - box[0]).max() <= _SLACK * across
        if not tight and across >= _WIDE:
            box, tight = surely + np.array([[-4], [4]]), True
        if (tight and across >= _FINEST) or last or len(cells) == whole:
            touches = bool((box[0] <= 0).any() or (box[1] >= np.array(grid.shape)).any())
            return grid.lower + box * grid.voxel, touches
        x, y, z = grid.shape
        grid = Grid(grid.lower, grid.voxel / 2, (2 * x, 2 * y, 2 * z))
        settled, cells = _split(cells[:whole]), _split(cells[whole:])


def _box_of(cells: np.ndarray) -> np.ndarray:
    """(2, 3) first and one past the last index."""
    return np.stack([cells.min(0), cells.max(0) + 1])


def _split(cells: np.ndarray) -> np.ndarray:
    """(8 M, 3) the eight halves of each cell."""
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    return (2 * cells[:, None] + corners).reshape(-1, 3)


def _staying(search: Search, grid: Grid, cells: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(M,) bool: the cells of pieces that the box must hold.

    Pieces are joined through every cell that may hold a part of the region, however thin; their volumes are
    estimated from the cells' centres, their silhouettes are those of the cells.

    Args:
        cells: (M, 3) that the rule may keep.
        inside: (M,) bool, those kept whole or with their centre.
    """
    low, high = _box_of(cells)
    # Labels on a coarser grid may join pieces, which can only keep more of them.
    shift = 0
    while np.prod(((high - low - 1) >> shift) + 1) > _MOST_LABELS:
        shift += 1
    where = (cells - low) >> shift
    occupancy = np.zeros(((high - low - 1) >> shift) + 1, bool)
    occupancy[tuple(where.T)] = True
    pieces = find_pieces(occupancy)
    labels = piece_of(where, occupancy.shape, pieces)
    if search.components == "explain":
        coarse = Grid(grid.lower + low * grid.voxel, grid.voxel * 2**shift, occupancy.shape)
        return explaining_pieces(pieces, occupancy, coarse, search.silhouettes, search.rule, search.areas)[
            labels
        ]
    volumes = np.bincount(labels, weights=inside, minlength=len(pieces.sizes))
    return (volumes >= 0.9 * search.drop_below * volumes.max())[labels]


def cube_around(box: np.ndarray, resolution: int) -> Grid:
    """A cube of `resolution` voxels per side around a box, with a margin of a few voxels."""
    side = float((box[1] - box[0]).max()) * resolution / max(resolution - 2 * MARGIN_VOXELS, 1)
    return Grid(box.mean(0) - side / 2, side / resolution, (resolution,) * 3)


def grid_in(bounds: np.ndarray, resolution: int) -> Grid:
    """Cubic voxels in an explicit box, `resolution` along its longest side; short sides are rounded up."""
    size = bounds[1] - bounds[0]
    voxel = float(size.max()) / resolution
    x, y, z = (int(n) for n in np.ceil(size / voxel - 1e-9).clip(1))
    return Grid(bounds[0], voxel, (x, y, z))
