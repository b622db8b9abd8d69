"""Summed-area tables: how many pixels of a rectangle of a mask are set, from four look-ups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.carving.votes import Silhouettes


class Areas(NamedTuple):
    """Summed-area tables of all masks, from `sum_areas`."""

    tables: np.ndarray
    """Flat int32; entry (r, c) of a view's table sums rows < r and columns < c."""
    starts: np.ndarray
    """(N,) int64 where each view's begins."""
    known: Areas | None = None
    """Those of what is known to be object, where there are pixels at which nothing is known."""

    def of_ballots(self) -> tuple[Areas, ...]:
        """One for each of `Silhouettes.ballots`."""
        return (self,) if self.known is None else (self, self.known)


@kernel(counted=False)
def _sum_areas(
    begin: int, end: int, pixels: np.ndarray, sizes: np.ndarray, offsets: np.ndarray,
    table_offsets: np.ndarray, tables: np.ndarray,
) -> None:  # fmt: skip
    for view in range(begin, end):
        width, height = sizes[view]
        stride = width + 1
        table = tables[table_offsets[view] : table_offsets[view] + stride * (height + 1)]
        table[:stride] = 0
        for row in range(height):
            above = table[row * stride : (row + 1) * stride]
            here = table[(row + 1) * stride : (row + 2) * stride]
            line = pixels[offsets[view] + row * width : offsets[view] + (row + 1) * width]
            # Two loops: the first goes pixel by pixel, the second takes many at a time.
            total, here[0] = np.int32(0), 0
            for column in range(width):
                total += line[column]
                here[column + 1] = total
            for column in range(stride):
                here[column] += above[column]


def sum_areas(silhouettes: Silhouettes) -> Areas:
    """Summed-area tables of all masks."""
    counts = (silhouettes.sizes + 1).prod(1)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    tables = np.empty(int(counts.sum()), np.int32)
    inputs = (silhouettes.pixels, silhouettes.sizes, silhouettes.offsets, starts)
    parallel_for(_sum_areas, len(silhouettes), 1, *inputs, tables)
    return Areas(tables, starts, None if silhouettes.unknown is None else sum_areas(silhouettes.demanding()))
