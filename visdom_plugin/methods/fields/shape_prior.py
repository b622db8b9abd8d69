"""A soft prior on density: empty between the hull and the shape inside it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Generator, Tensor

from visdom_plugin.hull.hull import Hull, occupied_box
from visdom_plugin.nerf.frame import Frame

MARGIN = 0.03
"""Nothing is asked this near to the shape, in radii of the hull: there photographs decide."""
LENGTH = 0.2
"""Radii of the hull over which density is turned into opacity."""
POINTS = 1024
"""In a step."""
MOST_VOXELS = 128
"""Along the longest side of the grid on which distances to the shape are measured."""


class ShapePrior:
    """Asks a field for its density at random points of the hull that are not in the shape inside it.

    The shape inside a hull is a guess, the hull a certainty: what the photographs say against the guess wins where
    the weight is small.

    Args:
        hull: with `inner`, the shape inside.
        frame: the field's.
    """

    def __init__(self, hull: Hull, frame: Frame):
        from scipy.ndimage import distance_transform_edt

        assert hull.inner is not None, "the hull comes without the shape inside it"
        lower, upper = occupied_box(hull.occupancy)
        stride = -(-int((upper - lower).max()) // MOST_VOXELS)
        window = tuple(slice(a, b, stride) for a, b in zip(lower, upper, strict=True))
        edges = stride * hull.voxel_edges
        distance = distance_transform_edt(~hull.inner.occupancy[window], sampling=edges)
        empty = hull.occupancy[window] & (distance > MARGIN * hull.radius)
        corner = hull.bounds[0] + lower * hull.voxel_edges
        self.frame, self.length = frame, LENGTH * hull.radius * frame.scale
        self._edges = torch.from_numpy(edges)
        self._corners = torch.from_numpy(corner + np.argwhere(empty) * edges)

    def loss(self, density: Callable[[Tensor], Tensor], generator: Generator) -> Tensor:
        """Mean opacity over `LENGTH` where nothing should be, scalar; 0 where the shape fills its hull.

        Args:
            density: points (m, 3) in the field's frame to density (m,) per unit of that frame.
            generator: CPU generator that draws the points.
        """
        if not len(self._corners):
            return torch.zeros(())
        corners = self._corners[torch.randint(len(self._corners), (POINTS,), generator=generator)]
        points = corners + self._edges * torch.rand(POINTS, 3, generator=generator, dtype=torch.float64)
        return (1 - (-density(self.frame.to_local(points)) * self.length).exp()).mean()
