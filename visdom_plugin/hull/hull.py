"""The hull: an occupancy grid in the world frame, and what can be asked of it."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast, overload

import numpy as np
import numpy.typing as npt
import torch
from torch import Generator, Tensor

from visdom_plugin.atomic_files import appearing, write_bytes
from visdom_plugin.errors import CheckpointError
from visdom_plugin.geometry.mesh_files import mesh_ply
from visdom_plugin.hull.foreign import Corners, check_bounds, check_grid
from visdom_plugin.hull.grid.mesh import mesh_grid

_SCHEMA = 1
Points = np.ndarray | Sequence[float] | Sequence[Sequence[float]]
T = TypeVar("T")


@dataclass(frozen=True, eq=False, repr=False)
class Hull:
    """Voxels that may hold the object. Never changed after it is made: its arrays are read-only.

    The constructor takes the occupancy over without a copy, and makes it read-only for its giver, too; `from_grid`
    copies.
    """

    occupancy: np.ndarray
    """(X, Y, Z) bool; voxel (0, 0, 0) lies at the lower corner. Read-only."""
    bounds: np.ndarray
    """(2, 3) float64 lower and upper corner of the grid, world frame. Read-only."""
    summary: dict[str, Any] = field(default_factory=dict)
    """How it was carved: rule, views, seconds, components; plain numbers and strings."""
    inner: Hull | None = None
    """The shape inside it, where somebody found it (`hull.inside.shape.shape_inside`): where Gaussians may start.
    The hull itself is what is certain, and is all that `save` writes."""
    _derived: dict[object, object] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", np.array(self.bounds, np.float64))
        object.__setattr__(self, "summary", dict(self.summary))
        _freeze(self.occupancy, self.bounds)

    @classmethod
    def from_grid(
        cls, array: Tensor | npt.ArrayLike, bounds: Corners, summary: dict[str, Any] | None = None
    ) -> Hull:
        """A hull from any occupancy grid; the array is copied.

        Args:
            array: (X, Y, Z) tensor or array; bool, or numbers of which those above 0.5 are inside. Voxel (0, 0, 0)
                lies at the lower corner.
            bounds: (2, 3) lower and upper corner of the grid, world frame: its outer faces, not voxel centres.

        Raises:
            ConfigError: for a grid that is not three-dimensional, holds no voxels or numbers that are not finite;
                or bounds that are not finite or not in order.
            EmptyHullError: when no voxel is inside.
        """
        return cls._checked(array, bounds, "Hull.from_grid", summary)

    @classmethod
    def _checked(
        cls,
        array: Tensor | npt.ArrayLike,
        bounds: Corners,
        where: object,
        summary: dict[str, Any] | None = None,
    ) -> Hull:
        return cls(check_grid(array, where), check_bounds(bounds, where), summary or {})

    def __getstate__(self) -> dict[str, object]:
        return self.__dict__ | {"_derived": {}}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        _freeze(self.occupancy, self.bounds)

    def _once(self, key: object, make: Callable[[], T]) -> T:
        if key not in self._derived:
            self._derived[key] = make()
        return cast(T, self._derived[key])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Hull):
            return NotImplemented
        same = np.array_equal(self.bounds, other.bounds)
        return same and np.array_equal(self.occupancy, other.occupancy)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        corners = (f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in self.bounds.tolist())
        parts = [f"{self.voxels} of {'x'.join(map(str, self.shape))} voxels", " .. ".join(corners)]
        parts += [f"{name}={self.summary[name]!r}" for name in ("kind", "views", "k") if name in self.summary]
        return f"Hull({', '.join(parts)})"

    def relative_to(self, origin: np.ndarray | Sequence[float]) -> Hull:
        """The same hull in the frame that has its origin at `origin` (3,), with the same axes; itself for zero."""
        shift = np.asarray(origin, np.float64)
        if not shift.any():
            return self
        inner = None if self.inner is None else self.inner.relative_to(shift)
        return Hull(self.occupancy, self.bounds - shift, self.summary, inner)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y, z."""
        return self.occupancy.shape

    @property
    def voxel_edges(self) -> np.ndarray:
        """(3,) edges of a voxel in scene units; equal for every hull that was carved."""
        return (self.bounds[1] - self.bounds[0]) / np.array(self.shape)

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel in scene units; the geometric mean should a foreign grid's voxels not be cubes."""
        return float(np.prod(self.voxel_edges) ** (1 / 3))

    @property
    def voxels(self) -> int:
        """Number of occupied voxels."""
        return self._once("voxels", lambda: int(np.count_nonzero(self.occupancy)))

    @property
    def volume(self) -> float:
        """Occupied voxels times the volume of one, cubic scene units."""
        return self.voxels * float(np.prod(self.voxel_edges))

    @property
    def surface_area(self) -> float:
        """Area of the mesh, square scene units. Voxel steps enlarge it."""
        return float(self._areas().sum())

    @property
    def extent(self) -> np.ndarray:
        """(2, 3) tight box around the occupied voxels, world frame; the grid's own box for an empty hull."""
        box = self._once("extent", lambda: self.bounds[0] + occupied_box(self.occupancy) * self.voxel_edges)
        return box.copy()

    @property
    def centre(self) -> np.ndarray:
        """(3,) mean of the occupied voxels' centres, world frame; of the box for an empty hull."""
        return self._once("centre", self._find_centre).copy()

    @property
    def radius(self) -> float:
        """Distance from `centre` to the farthest point of the mesh, scene units; 0 for an empty hull."""

        def measure() -> float:
            vertices, _ = self.to_mesh()
            return float(np.linalg.norm(vertices - self.centre, axis=1).max(initial=0))

        return self._once("radius", measure)

    def _find_centre(self) -> np.ndarray:
        if not self.voxels:
            return self.bounds.mean(0)
        weights = _count_planes(self.occupancy)
        index = np.array([(w * (np.arange(len(w)) + 0.5)).sum() / w.sum() for w in weights])
        return self.bounds[0] + index * self.voxel_edges

    @overload
    def contains(self, points: Tensor, *, margin_voxels: float = 0.0) -> Tensor: ...

    @overload
    def contains(self, points: Points, *, margin_voxels: float = 0.0) -> np.ndarray: ...

    def contains(self, points: Tensor | Points, *, margin_voxels: float = 0.0) -> Tensor | np.ndarray:
        """Whether points lie in occupied voxels. Points outside the grid do not.

        Args:
            points: (..., 3) tensor on any device, or array; world frame.
            margin_voxels: count points up to this far from an occupied voxel as inside, in voxels, largest
                difference over the axes, rounded up to whole voxels.

        Returns:
            (...) bool, of the same kind and on the same device.
        """
        if not isinstance(points, Tensor):
            return self.contains(torch.as_tensor(np.asarray(points)), margin_voxels=margin_voxels).numpy()
        reach = int(np.ceil(margin_voxels))

        def frame() -> tuple[Tensor, ...]:
            shape = np.array(self.shape) + 2 * reach
            values = self.bounds[0] - reach * self.voxel_edges, self.voxel_edges, shape
            return tuple(torch.from_numpy(x).to(points.device) for x in values)

        lower, edges, size = self._once(("frame around", str(points.device), reach), frame)
        index = torch.floor((points.detach().double() - lower) / edges)
        inside = ((index >= 0) & (index < size)).all(-1)
        x, y, z = torch.where(inside[..., None], index, 0.0).long().unbind(-1)
        if points.device.type == "cpu" and not reach:
            # numpy reads the grid itself; torch, which knows no read-only arrays, would need a copy.
            return inside & torch.from_numpy(np.asarray(self.occupancy[x.numpy(), y.numpy(), z.numpy()]))
        return inside & self._grid_on(points.device, reach)[x, y, z]

    def _grid_on(self, device: torch.device, reach: int = 0) -> Tensor:
        def make() -> Tensor:
            # torch knows no read-only arrays, so the grid is copied even where it does not grow.
            grid = np.pad(self.occupancy, reach)
            if reach:
                for axis in range(3):
                    row = np.moveaxis(grid, axis, 0)
                    grown = row.copy()
                    for shift in range(1, reach + 1):
                        grown[shift:] |= row[:-shift]
                        grown[:-shift] |= row[shift:]
                    grid = np.moveaxis(grown, 0, axis)
                grid = np.ascontiguousarray(grid)
            return torch.from_numpy(grid).to(device)

        return self._once(("grid", str(device), reach), make)

    def to_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """The surface of the occupied voxels.

        Returns:
            Vertices (V, 3) float64, world frame, and faces (F, 3) int64: closed, outward (anticlockwise seen
            from outside), every edge in exactly two faces. Both are read-only.
        """

        def make() -> tuple[np.ndarray, np.ndarray]:
            lower, upper = occupied_box(self.occupancy).astype(int)
            window = tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))
            # A copy also where the window is the whole grid: its kernel is compiled for writable arrays.
            vertices, faces = mesh_grid(self.occupancy[window].copy())
            vertices = self.bounds[0] + (vertices + lower) * self.voxel_edges
            _freeze(vertices, faces)
            return vertices, faces

        return self._once("mesh", make)

    def _areas(self) -> np.ndarray:
        def make() -> np.ndarray:
            vertices, faces = self.to_mesh()
            a, b, c = (vertices[faces[:, i]] for i in range(3))
            return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

        return self._once("areas", make)

    def sample_points(self, n: int, generator: Generator | None = None) -> Tensor:
        """Points on the surface, uniform by area.

        Args:
            n: how many.
            generator: CPU generator; torch's global one without.

        Returns:
            (n, 3) float64, world frame; (0, 3) for an empty hull.
        """
        if not self.voxels:
            return torch.zeros(0, 3, dtype=torch.float64)
        vertices, faces = self.to_mesh()
        cumulative = np.cumsum(self._areas())
        draw = torch.rand(n, 3, generator=generator, dtype=torch.float64).numpy()
        chosen = np.searchsorted(cumulative, draw[:, 0] * cumulative[-1], side="right")
        corners = vertices[faces[np.minimum(chosen, len(faces) - 1)]]
        root = np.sqrt(draw[:, 1])
        weights = np.stack([1 - root, root * (1 - draw[:, 2]), root * draw[:, 2]], -1)
        return torch.from_numpy((weights[..., None] * corners).sum(1))

    def sample_inside(self, n: int, generator: Generator | None = None) -> Tensor:
        """Points inside, uniform by volume: (n, 3) float64, world frame; (0, 3) for an empty hull."""
        if not self.voxels:
            return torch.zeros(0, 3, dtype=torch.float64)
        occupied = self._once("indices", lambda: np.flatnonzero(self.occupancy))
        chosen = torch.randint(len(occupied), (n,), generator=generator).numpy()
        within = torch.rand(n, 3, generator=generator, dtype=torch.float64).numpy()
        index = np.stack(np.unravel_index(occupied[chosen], self.shape), -1)
        return torch.from_numpy(self.bounds[0] + (index + within) * self.voxel_edges)

    def save(self, path: str | Path) -> None:
        """Writes a compressed .npz; the file appears whole or not at all."""
        packed = np.packbits(self.occupancy)
        header = {
            "schema": _SCHEMA,
            "shape": self.shape,
            "bounds": self.bounds.tolist(),
            "summary": self.summary,
        }
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        with appearing(Path(path)) as part, part.open("wb") as file:
            np.savez_compressed(file, header=text, occupancy=packed)

    @classmethod
    def load(cls, path: str | Path) -> Hull:
        """Reads what `save` wrote, or a grid made elsewhere: an .npz with the arrays `occupancy` (X, Y, Z) and
        `bounds` (2, 3), as `from_grid` takes them.

        Raises:
            CheckpointError: when the file is missing, damaged or of another kind or version.
            ConfigError, EmptyHullError: as `from_grid`, for a grid made elsewhere.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                if "header" not in file and "bounds" in file:
                    return cls._checked(file["occupancy"], file["bounds"], path)
                header = json.loads(file["header"].tobytes())
                packed = file["occupancy"]
            if header["schema"] != _SCHEMA:
                raise CheckpointError(
                    f"hull file of version {header['schema']}, this program reads {_SCHEMA}",
                    where=path,
                    todo="carve the hull again",
                )
            shape, count = tuple(header["shape"]), int(np.prod(header["shape"]))
            corners = np.array(header["bounds"], np.float64)
            if len(shape) != 3 or len(packed) != (count + 7) // 8 or corners.shape != (2, 3):
                raise ValueError("size of the grid")
            occupancy = np.unpackbits(packed, count=count).view(bool).reshape(shape)
            return cls(occupancy, corners, header["summary"])
        except (
            AttributeError,
            OSError,
            ValueError,
            KeyError,
            TypeError,
            EOFError,
            NotImplementedError,
            RuntimeError,
            zlib.error,
            zipfile.BadZipFile,
        ) as error:
            missing = isinstance(error, FileNotFoundError)
            raise CheckpointError(
                "there is no such hull file" if missing else "this is not a hull file, or it is damaged",
                where=path,
                todo="carve the hull again and save it with Hull.save, or np.savez(path, occupancy=, bounds=)",
            ) from error

    def write_ply(self, path: str | Path) -> None:
        """Writes the mesh as binary PLY, world frame; the file appears whole or not at all."""
        write_bytes(Path(path), mesh_ply(*self.to_mesh()))


def _freeze(*arrays: np.ndarray) -> None:
    for array in arrays:
        array.flags.writeable = False


def _count_planes(occupancy: np.ndarray) -> list[np.ndarray]:
    """Occupied voxels in each plane across x, y and z: three int64 arrays."""
    across_x = np.array([np.count_nonzero(plane) for plane in occupancy])
    grid, columns = occupancy.view(np.uint8), np.zeros(occupancy.shape[1:], np.int64)
    for first in range(0, len(grid), 255):  # as many as a byte can count
        columns += np.add.reduce(grid[first : first + 255], axis=0, dtype=np.uint8)
    return [across_x, columns.sum(1), columns.sum(0)]


def occupied_box(occupancy: np.ndarray) -> np.ndarray:
    """(2, 3) int: first and one past the last occupied index per axis; the whole grid where it is empty."""
    plane = np.asarray(occupancy.any(0))
    if not plane.any():
        return np.array([[0, 0, 0], occupancy.shape])
    lines = [np.asarray(line) for line in (occupancy.any((1, 2)), plane.any(1), plane.any(0))]
    return np.array([[line.argmax() for line in lines], [len(line) - line[::-1].argmax() for line in lines]])
