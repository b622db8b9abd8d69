"""Validation of grids from elsewhere, before they may be a hull."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError, EmptyHullError

Corners = Tensor | np.ndarray | Sequence[Tensor | npt.ArrayLike]
"""(2, 3) lower and upper corner."""


def check_grid(array: Tensor | npt.ArrayLike, where: object) -> np.ndarray:
    """(X, Y, Z) bool copy of a tensor or array of bool or numbers, of which those above 0.5 are inside.

    Raises:
        ConfigError: for another shape or kind, or numbers that are not finite.
        EmptyHullError: when nothing is inside.
    """
    array = to_numpy(array)
    if array.ndim != 3 or array.size == 0:
        raise ConfigError(
            f"a hull needs a grid (X, Y, Z), not shape {array.shape}",
            where=where,
            todo="drop batch and channel dimensions; index [x, y, z], lower corner first",
        )
    if array.dtype.kind not in "biuf":
        raise ConfigError(f"a hull needs a grid of bool or real numbers, not {array.dtype}", where=where)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ConfigError(
            f"{np.count_nonzero(~np.isfinite(array))} voxels of the grid are NaN or infinite",
            where=where,
            todo="decide first whether they are inside: np.nan_to_num(grid) > 0.5",
        )
    occupancy = array.astype(bool) if array.dtype.kind == "b" else array > 0.5
    if not occupancy.any():
        largest = "" if array.dtype.kind == "b" else f" (the largest number is {array.max():g})"
        raise EmptyHullError(
            f"no voxel of the grid is inside{largest}",
            where=where,
            cause="numbers that are not shares of 1: inside is above 0.5" if largest else None,
            todo="pass bool, by a threshold of your own",
        )
    return np.ascontiguousarray(occupancy)


def check_bounds(bounds: Corners, where: object) -> np.ndarray:
    """(2, 3) float64 lower and upper corner.

    Raises:
        ConfigError: for another shape, numbers that are not finite, or corners without extent between them.
    """
    try:
        if isinstance(bounds, Tensor | np.ndarray):
            bounds = np.array(to_numpy(bounds), np.float64)
        else:
            bounds = np.array([to_numpy(corner).tolist() for corner in bounds], np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"bounds {bounds!r} are not two corners",
            where=where,
            todo="pass ((x, y, z), (x, y, z)) in world units",
        ) from error
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise ConfigError(
            f"bounds {bounds.tolist()} are not two corners with lower < upper",
            where=where,
            cause="a centre and a size, or one corner per axis" if bounds.shape in ((2, 3), (3, 2)) else None,
            todo="pass ((x, y, z), (x, y, z)), lower corner first, in world units",
        )
    return bounds


def to_numpy(value: Tensor | npt.ArrayLike) -> np.ndarray:
    """A tensor on any device, with or without gradient, or what numpy takes for an array, as an array."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        half = value.dtype in (torch.float16, torch.bfloat16)
        return (value.float() if half else value).numpy()
    return np.asarray(value)
