"""Degenerate geometry that satisfies the keep rule: cameras at one point, hulls that no camera was pointed at.

Poses of another convention can put all cameras at one point. Round it the views agree by chance, on the scale of
rounding errors, and everything that is measured in distances between cameras looks sound.
"""

from __future__ import annotations

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.keep_rule import KeepRule
from visdom_plugin.hull.hull import Hull

ROUNDING, WRITTEN = 1e-9, 1e-5
"""How far apart equal positions may come out, as a part of their distance from the origin: by arithmetic in
float64, and by files of six digits. Cameras of a survey, which is far from its origin, may be nearer than that."""


def stand_at_one_point(cameras: Cameras, part: float = ROUNDING) -> bool:
    """Whether two cameras (N,) or more are nowhere farther apart than a part of their distance from the origin."""
    centres = cameras.centres.double().cpu().numpy()
    return len(centres) > 1 and bool(np.ptp(centres, axis=0).max() <= part * np.abs(centres).max())


def describe_speck(cameras: Cameras, hull: Hull) -> str | None:
    """What a hull is that is smaller than a pixel's footprint at its place; None for all others."""
    distances = (cameras.centres.double().cpu() - torch.from_numpy(hull.centre)).norm(dim=-1)
    footprint = float((distances / cameras.intrinsics[:, 0, 0].double().cpu()).median())
    size = float(np.ptp(hull.extent, axis=0).max())
    if size >= footprint:
        return None
    return f"the hull is a speck: it is {size:.2g} long, and a pixel spans {footprint:.2g} there"


def count_cameras_inside(rule: KeepRule, cameras: Cameras, hull: Hull) -> int:
    """How many cameras stand in the hull; 0 where one view is enough, whose hull begins at its camera."""
    return int(hull.contains(cameras.centres.double().cpu()).sum()) if needs_several(rule) else 0


def needs_several(rule: KeepRule) -> bool:
    """Whether no voxel stays that is inside a single mask."""
    return not rule.table()[:, :2].any()
