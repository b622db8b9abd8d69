"""Poses made to fit the masks, and what that did."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.refine.poses import LEAST_VIEWS, refine_poses


class Fitted(NamedTuple):
    """The result of `fit_to_masks`."""

    cameras: Cameras
    views: list[dict[str, float]]
    """Per view plain data for prepare.json: by how much its camera was turned."""
    note: str
    """One line."""


def fit_to_masks(
    cameras: Cameras,
    masks: Sequence[np.ndarray | None],
    ignored: Sequence[np.ndarray | None],
    names: Sequence[str],
) -> Fitted:
    """Turns the cameras of the views that have masks until the masks agree better.

    Raises:
        SceneError: fewer than LEAST_VIEWS views have masks.
    """
    known = [i for i, mask in enumerate(masks) if mask is not None]
    if len(known) < LEAST_VIEWS:
        raise SceneError(
            f"poses are refined by masks of {LEAST_VIEWS} views or more; {len(known)} of {len(masks)} have one",
            where="--refine-poses",
            todo="add photographs or masks (--masks, --mask-source), or leave --refine-poses out",
        )
    with phase("turning the cameras until the masks agree"):
        found = refine_poses(cameras[known], [m for m in masks if m is not None], [ignored[i] for i in known])
    motion = cameras.world_from_camera.clone()
    motion[torch.as_tensor(known)] = found.cameras.world_from_camera
    views: list[dict[str, float]] = [{} for _ in masks]
    for i, turned in zip(known, found.turned_deg.tolist(), strict=True):
        views[i] = {"turned_deg": round(turned, 4)}
    if not found.turned_deg.any():
        note = f"poses kept as they were: no turn makes masks agree better that miss by {found.before:.2f} px"
    else:
        most = int(np.argmax(found.turned_deg))
        note = (
            f"poses refined: masks miss each other by {found.after:.2f} px, {found.before:.2f} before; most "
            f"turned is {names[known[most]]}, by {found.turned_deg[most]:.2f} degrees"
        )
    return Fitted(Cameras(cameras.intrinsics, motion, cameras.width, cameras.height), views, note)
