"""Occupancy and visibility votes, counted the plain way: every voxel centre into every image.

A view sees a voxel when its centre is in front of the camera and inside the image, 0 <= u < width and
0 <= v < height; it says "occupied" when the pixel that holds the projection is on the mask. All arithmetic is
in float64 and in one order, which `octree` repeats, so that both agree voxel for voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras, require_batch
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.foreign import to_numpy

Device = torch.device | str
Masks = Sequence[Tensor | np.ndarray] | Tensor | np.ndarray
"""N masks (H, W), or one tensor or array (N, H, W)."""


class Grid(NamedTuple):
    """A box of cubic voxels."""

    lower: np.ndarray
    """(3,) float64 lower corner of the box, world frame."""
    voxel: float
    """Edge of a voxel in scene units."""
    shape: tuple[int, int, int]
    """Number of voxels along x, y, z."""

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) lower and upper corner."""
        return np.stack([self.lower, self.lower + self.voxel * np.asarray(self.shape)])

    def centres(self, axis: int) -> np.ndarray:
        """(n,) coordinates of the voxel centres along one axis."""
        return self.lower[axis] + (np.arange(self.shape[axis]) + 0.5) * self.voxel

    def planes(self, axis: int) -> np.ndarray:
        """(n + 1,) coordinates of the planes between voxels along one axis."""
        return self.lower[axis] + np.arange(self.shape[axis] + 1) * self.voxel


@dataclass(frozen=True)
class Silhouettes:
    """Masks of one capture with their projections."""

    projections: np.ndarray
    """(N, 3, 4) float64: world point to homogeneous pixel coordinates and depth."""
    sizes: np.ndarray
    """(N, 2) int64 width and height."""
    offsets: np.ndarray
    """(N,) int64 where each mask starts in `pixels`."""
    pixels: np.ndarray
    """All masks one after the other, row by row, uint8 0 or 1; 1 where nothing is known."""
    unknown: np.ndarray | None = None
    """The same of pixels at which nothing is known, or None where all are."""

    def __len__(self) -> int:
        return len(self.sizes)

    def mask(self, view: int) -> np.ndarray:
        """(H, W) uint8 of one view."""
        (width, height), start = self.sizes[view], self.offsets[view]
        return self.pixels[start : start + width * height].reshape(height, width)

    def unknown_in(self, view: int) -> np.ndarray | None:
        """(H, W) bool of one view, True where nothing is known; None where all is known in every view."""
        return None if self.unknown is None else replace(self, pixels=self.unknown).mask(view).astype(bool)

    def demanding(self) -> Silhouettes:
        """Only what is known to be object: what a hull has to explain."""
        if self.unknown is None:
            return self
        return replace(self, pixels=self.pixels & (1 - self.unknown), unknown=None)

    def ballots(self, rule: KeepRule) -> list[tuple[Silhouettes, KeepRule]]:
        """Silhouettes without unknown pixels, each with a rule that a voxel has to satisfy."""
        known = [] if self.unknown is None else [(self.demanding(), rule.of_known())]
        return [(replace(self, unknown=None), rule), *known]


def gather_silhouettes(
    cameras: Cameras, masks: Masks, ignore: Sequence[Tensor | np.ndarray | None] = (), *, dilate_px: int = 0
) -> Silhouettes:
    """Checks and packs cameras and masks.

    Args:
        cameras: (N,) cameras.
        masks: N tensors or arrays (H, W), True on the object; or one (N, H, W).
        ignore: N tensors or arrays (H, W) bool or None, True where nothing is known; or empty.
        dilate_px: grow each mask by a square of 2 * dilate_px + 1 pixels.

    Raises:
        SceneError: when cameras are no batch, counts or sizes do not match, or a mask is not bool or 0/1.
    """
    require_batch(cameras, "the cameras of the hull")
    if len(masks) != len(cameras):
        raise SceneError(
            f"{len(masks)} masks for cameras of shape {tuple(cameras.shape)}",
            todo="pass one mask per camera: cameras (N,), masks N x (H, W)",
        )
    sizes = torch.stack([cameras.width, cameras.height], -1).cpu().numpy().astype(np.int64)
    world = cameras.camera_from_world.double()[:, :3].cpu().numpy()
    projections = cameras.intrinsics.double().cpu().numpy() @ world
    counts = sizes.prod(1)
    offsets = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    pixels = np.empty(int(counts.sum()), np.uint8)
    unknown = np.zeros_like(pixels) if any(g is not None for g in ignore) else None
    for view, mask in enumerate(masks):
        mask = to_numpy(mask)
        width, height = sizes[view]
        if mask.shape != (height, width):
            raise SceneError(
                f"mask {view} has shape {mask.shape}, its camera's image has {height} rows and {width} columns",
                where=f"view {view}",
                todo="resize the masks to the images, or pass cameras.resized(...)",
                topic="size",
            )
        if mask.dtype != np.bool_ and not np.isin(mask, (0, 1)).all():
            raise SceneError(
                f"mask {view} holds values other than 0 and 1 ({mask.dtype})",
                where=f"view {view}",
                todo="threshold it first: mask > 0.5, or mask > 127",
            )
        mask = mask.astype(np.uint8)
        part = slice(offsets[view], offsets[view] + counts[view])
        ignored = ignore[view] if ignore else None
        if unknown is not None and ignored is not None:
            if tuple(ignored.shape) != mask.shape:
                raise SceneError(
                    f"ignored pixels {view} have shape {tuple(ignored.shape)}, the mask has {mask.shape}",
                    where=f"view {view}",
                )
            unknown[part] = to_numpy(ignored).reshape(-1) > 0
            mask &= 1 - unknown[part].reshape(mask.shape)
        if dilate_px:
            import cv2

            mask = cv2.dilate(mask, np.ones((2 * dilate_px + 1,) * 2, np.uint8))
        pixels[part] = mask.reshape(-1)
    if unknown is not None:
        pixels |= unknown
    return Silhouettes(np.ascontiguousarray(projections), sizes, offsets, pixels, unknown)


def axis_terms(projections: np.ndarray, coordinates: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The projection split by axis: homogeneous pixel = x_term[i] + y_term[j] + z_term[k].

    Args:
        projections: (N, 3, 4).
        coordinates: three arrays of coordinates along x, y and z.

    Returns:
        Three arrays (N, 3, n) float64; the translation is part of the last.
    """
    x, y, z = (projections[:, :, a, None] * coordinates[a] for a in range(3))
    return x, y, z + projections[:, :, 3, None]


def count_votes(
    silhouettes: Silhouettes, grid: Grid, device: Device = "cpu", chunk: int = 1 << 21
) -> tuple[Tensor, Tensor]:
    """Votes of every voxel, on any torch device.

    Args:
        chunk: voxels handled at a time.

    Returns:
        (occupied, visible): two int16 tensors (X, Y, Z) on `device`.
    """
    shape = grid.shape
    occupied, visible = (torch.zeros(shape, dtype=torch.int16, device=device) for _ in range(2))
    terms = axis_terms(silhouettes.projections, [grid.centres(a) for a in range(3)])
    x, y, z = (torch.from_numpy(t).to(device) for t in terms)
    pixels = torch.from_numpy(silhouettes.pixels).to(device)
    slab = max(1, chunk // (shape[1] * shape[2]))
    for start in range(0, shape[0], slab):
        rows = slice(start, start + slab)
        for view in range(len(silhouettes)):
            (width, height), offset = silhouettes.sizes[view].tolist(), int(silhouettes.offsets[view])
            u, v, depth = (x[view, c, rows, None, None] + y[view, c, :, None] + z[view, c] for c in range(3))
            u, v = u / depth, v / depth
            seen = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
            index = torch.where(seen, v, 0.0).long() * width + torch.where(seen, u, 0.0).long()
            visible[rows] += seen
            occupied[rows] += seen & (pixels[offset + index] > 0)
    return occupied, visible


def dense_carve(silhouettes: Silhouettes, grid: Grid, rule: KeepRule, device: Device = "cpu") -> Tensor:
    """(X, Y, Z) bool on `device`: the voxels that satisfy the rule."""
    kept = torch.ones(grid.shape, dtype=torch.bool, device=device)
    for ballot, its_rule in silhouettes.ballots(rule):
        occupied, visible = count_votes(ballot, grid, device)
        table = torch.from_numpy(its_rule.table().astype(bool)).to(device)
        kept &= table.flatten()[visible.int() * table.shape[1] + occupied.int()]
    return kept
