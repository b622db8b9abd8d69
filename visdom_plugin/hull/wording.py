"""Wording of advice: arguments for who calls the library, options for who runs a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple


class Wording(NamedTuple):
    """What to do, in the terms of who asked."""

    set_k: str
    """How K is set; {k} stands for its value."""
    allow_misses: str
    look: str
    """Where each view's part in a hull is shown."""
    more_views: str
    """{count} stands for how many are needed."""
    poses: str
    """What to do about poses in another convention; "" leaves it to what was found."""
    sheet: str
    """Where views and outlines are shown."""
    refine: str
    """How the pose of one view is refined; {view} stands for its position."""


LIBRARY = Wording(
    set_k="VisibleDomain(k={k})",
    allow_misses="VisibleDomain(max_misses=1)",
    look="see what visdom_plugin.hull.checks.check.check(cameras, masks) finds",
    more_views="use {count} views or more",
    poses="",
    sheet="draw masks and hull over the photographs",
    refine="refine its pose: visdom_plugin.hull.refine.poses.refine_poses(cameras, masks, free=[{view}])",
)
COMMANDS = Wording(
    set_k="--k {k}",
    allow_misses="visdom-hull --max-misses 1, visdom-train --method.hull.max-misses 1",
    look="look at each view's part in it: visdom-hull DIR --diagnose",
    more_views="use more views: --views {count} or more",
    poses="change the poses in the scene's file: `visdom-check DIR` tells how",
    sheet="look at the contact sheet (visdom-check DIR --out OUT)",
    refine="refine the poses of a COLMAP model or a transforms.json: visdom-prepare PHOTOS --poses POSES --masks "
    "MASKS --refine-poses --out SCENE",
)
_current: ContextVar[Wording] = ContextVar("wording", default=LIBRARY)


def wording() -> Wording:
    """The terms of who asked: the library's outside of commands."""
    return _current.get()


@contextmanager
def for_commands() -> Iterator[None]:
    """Advice within is given as options of the commands."""
    token = _current.set(COMMANDS)
    try:
        yield
    finally:
        _current.reset(token)
