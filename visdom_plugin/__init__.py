"""Visible-domain hulls for NeRF and Gaussian splatting from a handful of posed, masked photographs.

Names are imported when they are first used, so that commands answer `--help` without loading torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .moved import keep_old_places

if TYPE_CHECKING:
    from .errors import EmptyHullError, VisDomError
    from .geometry.cameras import Cameras, Rays
    from .hooks.regularizer import VisDomGaussianRegularizer
    from .hooks.sampler import VisDomSampler
    from .hull.domain import VisibleDomain
    from .hull.hull import Hull
    from .render import Render
    from .scene import Scene, Views
    from .workflow.runs import Run, open_run, save_image, train
    from .workflow.scenes import carve, check, load

__version__ = "0.2.0"

_HOME = {
    "Cameras": "visdom_plugin.geometry.cameras",
    "Rays": "visdom_plugin.geometry.cameras",
    "Render": "visdom_plugin.render",
    "Scene": "visdom_plugin.scene",
    "Views": "visdom_plugin.scene",
    "VisDomError": "visdom_plugin.errors",
    "EmptyHullError": "visdom_plugin.errors",
    "VisibleDomain": "visdom_plugin.hull.domain",
    "Hull": "visdom_plugin.hull.hull",
    "VisDomSampler": "visdom_plugin.hooks.sampler",
    "VisDomGaussianRegularizer": "visdom_plugin.hooks.regularizer",
    "load": "visdom_plugin.workflow.scenes",
    "check": "visdom_plugin.workflow.scenes",
    "carve": "visdom_plugin.workflow.scenes",
    "train": "visdom_plugin.workflow.runs",
    "open_run": "visdom_plugin.workflow.runs",
    "save_image": "visdom_plugin.workflow.runs",
    "Run": "visdom_plugin.workflow.runs",
}

__all__ = [
    "Cameras",
    "EmptyHullError",
    "Hull",
    "Rays",
    "Render",
    "Run",
    "Scene",
    "Views",
    "VisDomError",
    "VisDomGaussianRegularizer",
    "VisDomSampler",
    "VisibleDomain",
    "__version__",
    "carve",
    "check",
    "load",
    "open_run",
    "save_image",
    "train",
]


if not TYPE_CHECKING:  # a type checker would take any name for a public one

    def __getattr__(name: str) -> object:
        if name in _HOME:
            return getattr(import_module(_HOME[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


keep_old_places()


def __dir__() -> list[str]:
    return sorted(__all__)
