"""The shape of a multiresolution hash grid, without torch: configs hold it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from visdom_plugin.errors import ConfigError

PRIMES = (1, 2654435761, 805459861)
"""Instant-NGP's (Müller et al. 2022, equation 4)."""


@dataclass(frozen=True)
class HashLayout:
    """Levels of cubic grids over [0, 1]^3 whose vertices hold features, all in one table (rows, features).

    Level l has `resolutions[l]` cells along each axis, growing geometrically. A level whose (resolution + 1)^3
    vertices fit into 2^log2_table_size rows is dense, with a row for each vertex, x fastest; a finer one hashes
    its vertices into 2^log2_table_size rows: (x xor y * 2654435761 xor z * 805459861) mod the size, in 32 bits.
    """

    levels: int = 8
    """Grids, from coarse to fine."""
    features: int = 2
    """Numbers at each vertex of a level."""
    base_resolution: int = 16
    """Cells along each axis of the coarsest level."""
    max_resolution: int = 512
    """Cells along each axis of the finest level."""
    log2_table_size: int = 15
    """Rows of each level's table are at most 2 to the power of this."""

    def __post_init__(self):
        if self.levels < 1 or self.features < 1:
            raise ConfigError(
                "a hash grid needs levels and features",
                where=f"levels = {self.levels}, features = {self.features}",
                todo="give at least one of each",
            )
        if not 1 <= self.base_resolution <= self.max_resolution <= 1 << 20:
            raise ConfigError(
                "a hash grid's resolutions are out of order",
                where=f"base_resolution = {self.base_resolution}, max_resolution = {self.max_resolution}",
                todo="choose 1 <= base_resolution <= max_resolution <= 2^20",
            )
        if not 3 <= self.log2_table_size <= 24:
            raise ConfigError(
                "a hash grid's table size is out of range",
                where=f"log2_table_size = {self.log2_table_size}",
                todo="choose 3 to 24",
            )

    @cached_property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along each axis, by level: base * growth^level, growth = exp(ln(max / base) / (levels - 1))."""
        growth = math.log(self.max_resolution / self.base_resolution) / max(self.levels - 1, 1)
        return tuple(round(self.base_resolution * math.exp(growth * level)) for level in range(self.levels))

    @cached_property
    def dense(self) -> tuple[bool, ...]:
        """Whether a level has a row for each vertex."""
        return tuple((r + 1) ** 3 <= 1 << self.log2_table_size for r in self.resolutions)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Rows of each level."""
        pairs = zip(self.resolutions, self.dense, strict=True)
        return tuple((r + 1) ** 3 if dense else 1 << self.log2_table_size for r, dense in pairs)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First row of each level, and the number of rows at the end: (levels + 1,)."""
        return tuple(sum(self.sizes[:level]) for level in range(self.levels + 1))

    @property
    def rows(self) -> int:
        return self.offsets[-1]

    @property
    def width(self) -> int:
        """Numbers per encoded point."""
        return self.levels * self.features
