"""Built-in scenes, drawn when they are asked for."""

from __future__ import annotations

import warnings
from importlib import import_module

_MOVED = {"SyntheticConfig": "datamodules.synthetic.config", "make_scene": "datamodules.synthetic.scene"}
"""Names that this was a module of, in version 0.1, by where they are now."""


def __getattr__(name: str) -> object:
    if name not in _MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    what = f"{__name__}.{name} is now {_MOVED[name]}.{name}; the old name goes with version 0.3"
    warnings.warn(what, DeprecationWarning, stacklevel=2)
    found: object = getattr(import_module(_MOVED[name]), name)
    return found
