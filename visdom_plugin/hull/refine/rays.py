"""Rays through the masks' outlines: where along each the other masks agree best, and how they would move it.

Everything is in the pixels of `Outlines`. A ray through the outline of one mask touches the object, so some point
of it lies inside every mask that sees it (silhouette coherence; Hernandez, Schmitt and Cipolla, PAMI 2007). How
far outside a mask a point lies is read from the mask's distance field and taken as a soft hinge,
softness * log(1 + exp(distance / softness)), so that points just inside count a little, too: otherwise a step
stops at the first mask that it runs into.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.outlines.distance_fields import UNKNOWN_BELOW, Outlines, is_known

_CHUNK = 64
_FREE = -1e3
"""Distance where a view says nothing: behind it, outside its frame, at unknown pixels."""
_FADE = 0.06
"""Over this part of the frame's longer side before its border a mask's pull fades out: what leaves the frame must
not do so by a leap."""
_STEPS, _FINE_STEPS = 96, 16
_REACH = 1.2
"""Depths are tried over the object's ball, this much larger."""
_SUPPORT = 3
"""Views that must see a point, where as many can."""
_FAR_PX = 30.0
"""Rays that miss the other masks by more are no part of one object seen from roughly known poses."""
_HUBER_PX = 4.0


class Rays(NamedTuple):
    """Rays through outlines, with a point on each."""

    view: np.ndarray
    """(P,) int64."""
    uv: np.ndarray
    """(P, 2) the outline's pixel, in the fields' pixels."""
    depth: np.ndarray
    """(P,) along the ray of unit length."""


class Packed(NamedTuple):
    """Outlines as the kernels read them."""

    rotations: np.ndarray
    centres: np.ndarray
    intrinsics: np.ndarray
    sizes: np.ndarray
    offsets: np.ndarray
    fields: np.ndarray


class System(NamedTuple):
    """Normal equations of one Gauss-Newton step over all views' poses, each ray's depth eliminated."""

    cost: float
    matrix: np.ndarray
    """(6 N, 6 N): per view three for its turn in radians about its own axes, three for its move in parts of its
    distance to the object."""
    vector: np.ndarray
    """(6 N,) gradient."""
    depth_step: np.ndarray
    """(P,) step of each depth where no pose changes."""
    depth_per_pose: np.ndarray
    """(P, 6 N) what a change of the poses adds to it."""


def pack(outlines: Outlines) -> Packed:
    """Outlines in arrays, the fields one after the other."""
    sizes = np.array([f.shape[::-1] for f in outlines.fields], np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes.prod(1))[:-1]]).astype(np.int64)
    fields = np.concatenate([f.ravel() for f in outlines.fields])
    return Packed(outlines.rotations, outlines.centres, outlines.intrinsics, sizes, offsets, fields)


def outline_pixels(outlines: Outlines, per_view: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the outlines, evenly spread, none within two pixels of the frame's border.

    Returns:
        view (P,) int64 and uv (P, 2) float64.
    """
    views, pixels = [], []
    for i, field in enumerate(outlines.fields):
        inner = np.zeros(field.shape, bool)
        inner[2:-2, 2:-2] = True
        index = np.flatnonzero((field < 0) & (field > -1.2) & is_known(field) & inner)
        count = min(per_view, len(index))
        row, column = np.divmod(index[np.arange(count) * len(index) // max(count, 1)], field.shape[1])
        right = (field[row, column + 1] - field[row, column - 1]) / 2
        down = (field[row + 1, column] - field[row - 1, column]) / 2
        onto = field[row, column] / np.maximum(right * right + down * down, 0.25)
        views.append(np.full(count, i, np.int64))
        pixels.append(np.stack([column + 0.5 - onto * right, row + 0.5 - onto * down], -1))
    return np.concatenate(views), np.concatenate(pixels).astype(np.float64)


@kernel()
def _read(
    fields: np.ndarray, offset: int, width: int, height: int, u: float, v: float
) -> tuple[float, float, float]:
    """A field's value between pixel centres, bilinear, and its derivatives; faded out towards the border."""
    edge = min(min(u, width - u), min(v, height - v))
    if edge <= 0 or width < 2 or height < 2:
        return _FREE, 0.0, 0.0
    a, b = min(max(u - 0.5, 0.0), width - 1.001), min(max(v - 0.5, 0.0), height - 1.001)
    column, row = int(a), int(b)
    a, b = a - column, b - row
    at = offset + row * width + column
    f00, f01 = float(fields[at]), float(fields[at + 1])
    f10, f11 = float(fields[at + width]), float(fields[at + width + 1])
    value = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
    if value < UNKNOWN_BELOW:
        return _FREE, 0.0, 0.0
    du = (1 - b) * (f01 - f00) + b * (f11 - f10)
    dv = (1 - a) * (f10 - f00) + a * (f11 - f01)
    band = _FADE * max(width, height)
    if value > 0 and edge < band:
        q = edge / band
        fade, slope = q * q * (3 - 2 * q), 6 * q * (1 - q) / band
        du, dv = du * fade, dv * fade
        if edge == u:
            du += value * slope
        elif edge == width - u:
            du -= value * slope
        elif edge == v:
            dv += value * slope
        else:
            dv -= value * slope
        value *= fade
    return value, du, dv


@kernel()
def _direction(
    uv: np.ndarray, intrinsics: np.ndarray, rotation: np.ndarray, ray: np.ndarray, world: np.ndarray
) -> None:
    """Unit direction of a pixel in the camera's and in the world's axes."""
    ray[0] = (uv[0] - intrinsics[0, 2]) / intrinsics[0, 0]
    ray[1] = (uv[1] - intrinsics[1, 2]) / intrinsics[1, 1]
    ray[2] = 1.0
    length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0)
    for c in range(3):
        ray[c] /= length
    for c in range(3):
        world[c] = rotation[c, 0] * ray[0] + rotation[c, 1] * ray[1] + rotation[c, 2] * ray[2]


@kernel()
def _seen_from(
    rotation: np.ndarray, centre: np.ndarray, intrinsics: np.ndarray, point: np.ndarray, seen: np.ndarray
) -> tuple[float, float]:
    """The point in a camera's axes, and its pixel."""
    for c in range(3):
        seen[c] = (
            rotation[0, c] * (point[0] - centre[0])
            + rotation[1, c] * (point[1] - centre[1])
            + rotation[2, c] * (point[2] - centre[2])
        )
    if seen[2] <= 0:
        return -1.0, -1.0
    u = intrinsics[0, 0] * seen[0] / seen[2] + intrinsics[0, 2]
    return u, intrinsics[1, 1] * seen[1] / seen[2] + intrinsics[1, 2]


@kernel()
def _search(
    begin: int, end: int, view: np.ndarray, uv: np.ndarray, rotations: np.ndarray, centres: np.ndarray,
    intrinsics: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, fields: np.ndarray, middle: np.ndarray,
    radius: float, depth: np.ndarray, miss: np.ndarray,
) -> None:  # fmt: skip
    views = len(sizes)
    ray, d, x, y = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for p in range(begin, end):
        i = view[p]
        _direction(uv[p], intrinsics[i], rotations[i], ray, d)
        along = 0.0
        for c in range(3):
            along += (middle[c] - centres[i, c]) * d[c]
        low, high = max(along - _REACH * radius, 1e-3 * abs(along)), along + _REACH * radius
        best, support = np.inf, -1
        for level in range(2):
            steps = _STEPS if level == 0 else _FINE_STEPS
            at = 0.5 * (low + high) if support < 0 else depth[p]
            for k in range(steps + 1):
                t = low + (high - low) * k / steps
                for c in range(3):
                    x[c] = centres[i, c] + t * d[c]
                worst, seen = _FREE, 0
                for j in range(views):
                    if j == i:
                        continue
                    u, v = _seen_from(rotations[j], centres[j], intrinsics[j], x, y)
                    value = _read(fields, offsets[j], sizes[j, 0], sizes[j, 1], u, v)[0]
                    if value > _FREE:
                        seen += 1
                        worst = max(worst, value)
                seen = min(seen, _SUPPORT)
                if (seen > support and level == 0) or (seen == support and worst < best):
                    support, best, at = seen, worst, t
            depth[p], miss[p] = at, best
            step = (high - low) / steps
            low, high = at - step, at + step
        if support <= 0:
            miss[p] = np.inf


@kernel()
def _accumulate(
    begin: int, end: int, view: np.ndarray, uv: np.ndarray, depth: np.ndarray, rotations: np.ndarray,
    centres: np.ndarray, intrinsics: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, fields: np.ndarray,
    distance: np.ndarray, softness: float, damping: float, only_cost: bool, cost: np.ndarray,
    matrix: np.ndarray, vector: np.ndarray, depth_step: np.ndarray, depth_per_pose: np.ndarray,
) -> None:  # fmt: skip
    views = len(sizes)
    ray, d, x, y, gy, gx = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    rows, own = np.empty((views, 6)), np.empty((views, 6))
    other, slope = np.empty(views, np.int64), np.empty(views)
    weight, miss = np.empty(views), np.empty(views)
    for chunk in range(begin, end):
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(view))):
            i, t, active = view[p], depth[p], 0
            _direction(uv[p], intrinsics[i], rotations[i], ray, d)
            for c in range(3):
                x[c] = centres[i, c] + t * d[c]
            for j in range(views):
                if j == i:
                    continue
                u, v = _seen_from(rotations[j], centres[j], intrinsics[j], x, y)
                value, du, dv = _read(fields, offsets[j], sizes[j, 0], sizes[j, 1], u, v)
                if value < -12 * softness:
                    continue
                q = min(value / softness, 30.0)
                soft = value if q >= 30 else softness * np.log1p(np.exp(q))
                pull = 1 / (1 + np.exp(-q))
                if soft <= _HUBER_PX:
                    weight[active] = 1.0
                    cost[chunk] += 0.5 * soft * soft
                else:
                    weight[active] = _HUBER_PX / soft
                    cost[chunk] += _HUBER_PX * (soft - 0.5 * _HUBER_PX)
                if only_cost:
                    continue
                gy[0] = pull * du * intrinsics[j, 0, 0] / y[2]
                gy[1] = pull * dv * intrinsics[j, 1, 1] / y[2]
                gy[2] = -(gy[0] * y[0] + gy[1] * y[1]) / y[2]
                slope[active] = 0.0
                for c in range(3):
                    gx[c] = (
                        rotations[j, c, 0] * gy[0] + rotations[j, c, 1] * gy[1] + rotations[j, c, 2] * gy[2]
                    )
                    slope[active] += gx[c] * d[c]
                # Turning camera j by w about its own axes moves the point in them by y x w; turning the ray's own
                # camera moves the point by t R (w x ray).
                rows[active, 0] = gy[1] * y[2] - gy[2] * y[1]
                rows[active, 1] = gy[2] * y[0] - gy[0] * y[2]
                rows[active, 2] = gy[0] * y[1] - gy[1] * y[0]
                for c in range(3):
                    gy[c] = t * (
                        rotations[i, 0, c] * gx[0] + rotations[i, 1, c] * gx[1] + rotations[i, 2, c] * gx[2]
                    )
                    rows[active, 3 + c] = -gx[c] * distance[j]
                    own[active, 3 + c] = gx[c] * distance[i]
                own[active, 0] = ray[1] * gy[2] - ray[2] * gy[1]
                own[active, 1] = ray[2] * gy[0] - ray[0] * gy[2]
                own[active, 2] = ray[0] * gy[1] - ray[1] * gy[0]
                other[active], miss[active] = j, soft
                active += 1
            if only_cost or active == 0:
                continue
            stiff, push = 0.0, 0.0
            b = depth_per_pose[p]
            for k in range(active):
                j, w = other[k], weight[k]
                stiff += w * slope[k] * slope[k]
                push += w * slope[k] * miss[k]
                for c in range(6):
                    b[6 * i + c] += w * slope[k] * own[k, c]
                    b[6 * j + c] += w * slope[k] * rows[k, c]
                    vector[chunk, 6 * i + c] += w * miss[k] * own[k, c]
                    vector[chunk, 6 * j + c] += w * miss[k] * rows[k, c]
                    for e in range(6):
                        matrix[chunk, 6 * i + c, 6 * i + e] += w * own[k, c] * own[k, e]
                        matrix[chunk, 6 * j + c, 6 * j + e] += w * rows[k, c] * rows[k, e]
                        matrix[chunk, 6 * i + c, 6 * j + e] += w * own[k, c] * rows[k, e]
                        matrix[chunk, 6 * j + c, 6 * i + e] += w * rows[k, c] * own[k, e]
            if stiff <= 0:
                continue
            stiff *= 1 + damping
            depth_step[p] = -push / stiff
            for c in range(6 * views):
                if b[c] != 0:
                    vector[chunk, c] -= b[c] * push / stiff
                    for e in range(6 * views):
                        matrix[chunk, c, e] -= b[c] * b[e] / stiff
            for c in range(6 * views):
                b[c] = -b[c] / stiff


def find_points(
    packed: Packed, view: np.ndarray, uv: np.ndarray, ball: tuple[np.ndarray, float]
) -> tuple[Rays, np.ndarray]:
    """On each ray the point that lies least outside the other masks, among those that most views see.

    Args:
        ball: centre (3,) and radius of the object, roughly.

    Returns:
        The rays that come near agreement, and how far their points lie outside of the worst mask (P,), in pixels,
        negative inside.
    """
    depth, miss = np.zeros(len(view)), np.full(len(view), np.inf)
    parallel_for(_search, len(view), _CHUNK, view, uv, *packed, np.asarray(ball[0]), ball[1], depth, miss)
    close = miss < _FAR_PX
    return Rays(view[close], uv[close], depth[close]), miss[close]


def assemble(packed: Packed, rays: Rays, distance: np.ndarray, softness: float, damping: float) -> System:
    """Normal equations of all rays' soft hinges, with Huber's weights.

    Args:
        distance: (N,) from each camera to the object, the unit of its moves.
        softness: pixels.
        damping: of the depths' own equations, as a part of their diagonal.
    """
    return _run(packed, rays, distance, softness, damping, False)


def cost_of(packed: Packed, rays: Rays, distance: np.ndarray, softness: float) -> float:
    """`System.cost` alone."""
    return _run(packed, rays, distance, softness, 0.0, True).cost


def _run(
    packed: Packed, rays: Rays, distance: np.ndarray, softness: float, damping: float, only_cost: bool
) -> System:
    count, size = len(rays.view), 6 * len(packed.sizes)
    chunks = -(-count // _CHUNK)
    cost, vector = np.zeros(chunks), np.zeros((chunks, 1 if only_cost else size))
    matrix = np.zeros((chunks, *(vector.shape[1],) * 2))
    steps, per_pose = np.zeros(count), np.zeros((count, vector.shape[1]))
    parallel_for(
        _accumulate, chunks, 1, *rays, *packed, distance, softness, damping, only_cost, cost, matrix, vector,
        steps, per_pose,
    )  # fmt: skip
    return System(float(cost.sum()), matrix.sum(0), vector.sum(0), steps, per_pose)
