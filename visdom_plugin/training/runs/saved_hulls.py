"""The hulls of a run: carved or read from its folder hull/, with the shape inside where Gaussians start in it."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visdom_plugin.atomic_files import appearing
from visdom_plugin.compute.waiting import phase
from visdom_plugin.errors import CheckpointError, ConfigError
from visdom_plugin.scene import Views

if TYPE_CHECKING:
    from visdom_plugin.hull.hull import Hull

log = logging.getLogger(__name__)

HULL, REFERENCE, INNER = "hull.npz", "reference.npz", "inside.npz"
"""In a run's folder hull/: the hull of its method, that of its metrics where it is another, and the shape inside
the method's."""


def find_hull(config: Any, views: Views, saved: Path | None) -> Hull | None:
    """The hull that a method's settings ask for, None where they ask for none.

    With `initial_shape` "inside", or a `prior_weight`, it has the shape inside as `hull.inner`; where that cannot
    be had, the log says why, and Gaussians start in the hull, fields have no prior.

    Args:
        saved: the folder in which the run keeps its hulls, if it has one: what is there is read, not carved again.
    """
    if getattr(config, "hull", None) is None:
        return None
    hull = read_hull(saved / HULL) if saved is not None else None
    hull = config.hull.carve(*views.silhouettes()) if hull is None else hull
    if getattr(config, "initial_shape", "hull") == "inside" or getattr(config, "prior_weight", 0) > 0:
        hull = replace(hull, inner=_find_inner(config, hull, views, saved))
    return hull


def _find_inner(config: Any, hull: Hull, views: Views, saved: Path | None) -> Hull | None:
    inner = read_hull(saved / INNER) if saved is not None else None
    if inner is None:
        from visdom_plugin.hull.inside.shape import shape_inside

        try:
            images = [views.images[i] for i in views.with_masks()]
            cameras, masks, ignore = views.silhouettes()
            with phase("finding the shape inside the hull"):
                inner = shape_inside(hull, cameras, masks, ignore, config.inside, images)
        except ConfigError as error:
            log.warning("training goes by the hull alone, not by the shape inside it: %s", error.what)
    return inner


def write_hull(hull: Hull, folder: Path) -> None:
    """hull.npz and hull.ply, and the same of the shape inside where there is one, each in one step; files that are
    there already are of the same run."""
    for shape, name in ((hull, HULL), (hull.inner, INNER)):
        if shape is None:
            continue
        for file, write in (
            (folder / name, shape.save),
            ((folder / name).with_suffix(".ply"), shape.write_ply),
        ):
            if not file.exists():
                with appearing(file) as part:
                    write(part)


def read_hull(path: Path) -> Hull | None:
    """A hull that a run has saved; None where there is none, or, with a warning, where it cannot be read."""
    from visdom_plugin.hull.hull import Hull

    if not path.exists():
        return None
    try:
        return Hull.load(path)
    except CheckpointError as error:
        log.warning("%s\n  the hull is carved again", error)
        return None
