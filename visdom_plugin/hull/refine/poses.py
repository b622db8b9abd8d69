"""Poses refined by silhouettes: small turns of the cameras that make the masks agree.

Levenberg-Marquardt over all cameras' turns and the depths of the points on the rays through the outlines, with
soft hinges. Close to the truth only those rays bind that touch a rim of the object which two cameras see at once
(epipolar tangencies), two for every pair of views. That determines a turn of each camera from six views on; a
move of each as well only from many more. So cameras keep their places unless they are said to be uncertain. One
thing is hardly told by masks whatever the views: all cameras turned so that the object seems to stand a little
beside its place. A hull is carved there just as well.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import Masks, gather_silhouettes
from visdom_plugin.hull.outlines.distance_fields import Outlines, draw_outlines
from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence
from visdom_plugin.hull.refine.rays import Rays, assemble, cost_of, find_points, outline_pixels, pack

log = logging.getLogger(__name__)

_OBJECT_PX = 256
_RAYS = 512
_SOFTNESS_PX = (2.0, 1.0, 0.5, 0.25)
"""Of one cycle's rounds: hard hinges are exact but stop at the first masks they meet, soft ones let go again."""
_CYCLES, _STEPS = 15, 8
_SPREAD_PX = 0.5
"""Standard deviation of one outline's word."""
_WORDS = 40
"""Independent words in the outline of one mask: neighbouring rays repeat each other."""
_ENOUGH_DEG = 0.005
"""No turn in a round of a whole cycle is larger: that is the end."""
LEAST_VIEWS = 6
"""Fewer views leave the turns of all cameras open: with four, masks agree best far from the truth."""
_MOST_SPREADS = 4.0
"""A turn of so many standard deviations is no correction: nothing is changed then."""
_AGREE_PX = 0.01
"""Mean residual below which masks agree already and nothing is changed."""


@dataclass(frozen=True)
class RefineConfig:
    """How uncertain the given poses are; corrections are weighed against it."""

    turn_deg: float = 2.0
    """Standard deviation of each camera's orientation about each of its axes."""
    move: float = 0.0
    """Standard deviation of each camera's place along each axis, as a part of its distance; 0 keeps all places."""

    def check(self) -> None:
        """Raises ConfigError for a field out of its range."""
        for name, value, low, high in (
            ("turn_deg", self.turn_deg, 1e-3, 45.0),
            ("move", self.move, 0.0, 0.5),
        ):
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"RefineConfig.{name} is {value}", todo=f"give {low:g} to {high:g}")


class Refined(NamedTuple):
    """The result of `refine_poses`."""

    cameras: Cameras
    """The refined ones; the given ones where that did not make the masks agree better."""
    turned_deg: np.ndarray
    """(N,) by how many degrees each was turned."""
    moved: np.ndarray
    """(N,) by how much each was moved, as a part of its distance to the object."""
    before: float
    """Mean residual of the masks' rays, in pixels of masks about 256 pixels long."""
    after: float


def refine_poses(
    cameras: Cameras,
    masks: Masks,
    ignore: Sequence[Tensor | np.ndarray | None] = (),
    config: RefineConfig | None = None,
    *,
    free: Sequence[int] | None = None,
) -> Refined:
    """Turns cameras by a little, so that some point of every ray through a mask lies inside the other masks.

    Args:
        cameras: (N,) with poses that are roughly right: within a few degrees.
        masks: N tensors or arrays (H, W), True on the object; or one (N, H, W).
        ignore: N tensors or arrays (H, W) bool or None, True where nothing is known; or empty.
        free: the views whose cameras may be turned; all by default.

    Raises:
        ConfigError: a field of the config, or a view that is free, is out of range.
        SceneError: cameras and masks do not belong together (as `carve`); or fewer than LEAST_VIEWS views, unless
            only one camera is free, which needs three.
    """
    config = config or RefineConfig()
    config.check()
    if free is not None and not all(0 <= i < len(cameras) for i in free):
        raise ConfigError(f"free is {list(free)}", todo=f"give positions from 0 to {len(cameras) - 1}")
    least = LEAST_VIEWS if free is None or len(free) > 1 else 3
    if len(cameras) < least:
        raise SceneError(
            f"poses are refined by the masks of {least} views or more, and these are {len(cameras)}",
            cause="fewer leave open how the cameras are turned: masks agree as well far from the truth",
            todo="use more views, or free one camera only",
        )
    outlines = draw_outlines(cameras, gather_silhouettes(cameras, masks, ignore), object_px=_OBJECT_PX)
    before = measure_coherence(outlines, power=False).score
    zeros = np.zeros(len(cameras))
    still = Refined(cameras, zeros, zeros, before, before)
    if before <= _AGREE_PX:
        return still
    found = solve(outlines, config, range(len(cameras)) if free is None else free)
    after = measure_coherence(found, power=False).score if found else before
    if found is None or not after < before:
        return still
    turn = np.einsum("nij,nik->njk", outlines.rotations, found.rotations)
    # Not by the arc cosine of the trace, which tells no turns below a millionth of a degree from none.
    sine = np.linalg.norm(turn - turn.transpose(0, 2, 1), axis=(1, 2)) / math.sqrt(8)
    cosine = (np.trace(turn, axis1=1, axis2=2) - 1) / 2
    motion = cameras.world_from_camera.clone()
    motion[:, :3, :3] = torch.as_tensor(found.rotations).to(motion)
    motion[:, :3, 3] = torch.as_tensor(found.centres).to(motion)
    shift = np.linalg.norm(found.centres - outlines.centres, axis=1) / _distances(found)
    turned = np.degrees(np.arctan2(sine, cosine))
    if turned.max() > _MOST_SPREADS * config.turn_deg:
        log.warning(
            "poses are kept: masks would agree better only with a camera turned by %.1f degrees", turned.max()
        )
        return still
    refined = Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)
    return Refined(refined, turned, shift, before, after)


def _distances(outlines: Outlines) -> np.ndarray:
    """(N,) from each camera to where the object seems to be; ones where it is nowhere."""
    ball = measure_coherence(outlines, 128, power=False).ball
    return np.ones(len(outlines)) if ball is None else np.linalg.norm(outlines.centres - ball[0], axis=1)


def solve(
    outlines: Outlines, config: RefineConfig, free: Sequence[int], *, rays: int = _RAYS, cycles: int = _CYCLES
) -> Outlines | None:
    """The views with the poses that fit best; None where the masks agree nowhere.

    Args:
        free: the views whose cameras may be turned.
        rays: of each view.
        cycles: of hinges from soft to hard, at most.
    """
    views = len(outlines)
    spread = np.tile(np.repeat([math.radians(config.turn_deg), config.move], 3), views)
    held = np.ones(views, bool)
    held[list(free)] = False
    index = np.flatnonzero((spread > 0) & ~np.repeat(held, 6))
    distance = _distances(outlines)
    change, damping = np.zeros(6 * views), 1e-3
    level = logging.INFO if len(free) > 1 else logging.DEBUG
    for cycle in range(cycles):
        largest = 0.0
        for softness in _SOFTNESS_PX:
            ball = measure_coherence(outlines, 128, power=False).ball
            if ball is None:
                return None
            view, uv = outline_pixels(outlines, rays)
            points, _ = find_points(pack(outlines), view, uv, ball)
            if not len(points.view):
                return None
            weight = _WORDS * views / len(view) / _SPREAD_PX**2
            before = change
            for _ in range(_STEPS):
                tried = _step(outlines, points, distance, softness, weight, change, spread, index, damping)
                if tried is None:
                    damping = 1e-3
                    break
                outlines, points, step, damping = tried
                change = change + step
            largest = max(largest, float(np.abs(change - before).reshape(views, 6)[:, :3].max()))
        turned = math.degrees(largest)
        log.log(
            level, "poses by silhouettes: round %d of %d, turned by %.3f degrees", cycle + 1, cycles, turned
        )
        if turned < _ENOUGH_DEG:
            break
    return outlines


def _step(
    outlines: Outlines, rays: Rays, distance: np.ndarray, softness: float, weight: float, change: np.ndarray,
    spread: np.ndarray, index: np.ndarray, damping: float,
) -> tuple[Outlines, Rays, np.ndarray, float] | None:  # fmt: skip
    """One step that lowers the cost, with the damping to go on with; None where none does."""
    packed = pack(outlines)
    precision = 1 / spread[index] ** 2
    views = len(outlines)
    while damping < 1e6:
        system = assemble(packed, rays, distance, softness, damping)
        matrix = weight * system.matrix[np.ix_(index, index)] + np.diag(precision)
        vector = weight * system.vector[index] + change[index] * precision
        step = np.zeros(6 * views)
        step[index] = -np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), vector)
        turns, moves = step.reshape(views, 2, 3).transpose(1, 0, 2)
        tried = replace(
            outlines,
            rotations=outlines.rotations @ rotations(turns),
            centres=outlines.centres + distance[:, None] * moves,
        )
        # A depth is looked for anew in every round; within one it must not leap to another part of the object.
        most = 0.03 * distance[rays.view]
        deeper = system.depth_step + (system.depth_per_pose * step).sum(1)
        moved = rays._replace(depth=rays.depth + np.clip(deeper, -most, most))
        now = weight * system.cost + 0.5 * (change[index] ** 2 * precision).sum()
        then = weight * cost_of(pack(tried), moved, distance, softness)
        if then + 0.5 * ((change + step)[index] ** 2 * precision).sum() < now:
            return tried, moved, step, max(damping / 5, 1e-6)
        damping *= 5
    return None


def rotations(turns: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations by the vectors (N, 3), in radians about their directions (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=-1)[:, None, None]
    zero = np.zeros(len(turns))
    x, y, z = turns.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return (
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)
    )
