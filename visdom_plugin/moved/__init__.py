"""Old places of modules that version 0.1 documented: they still import, with a DeprecationWarning, until 0.3."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "visdom_plugin.cameras": "visdom_plugin.geometry.cameras",
    "visdom_plugin.hooks.adapters": "visdom_plugin.integrations",
    "visdom_plugin.hooks.adapters.gsplat": "visdom_plugin.integrations.gsplat",
    "visdom_plugin.hooks.adapters.nerfacc": "visdom_plugin.integrations.nerfacc",
    "visdom_plugin.hosts": "visdom_plugin.integrations",
    "visdom_plugin.hosts.nerfstudio": "visdom_plugin.integrations.nerfstudio",
    "visdom_plugin.hosts.nerfstudio.dataparser": "visdom_plugin.integrations.nerfstudio.dataparser",
    "visdom_plugin.hosts.nerfstudio.fields": "visdom_plugin.integrations.nerfstudio.fields",
    "visdom_plugin.hosts.nerfstudio.methods": "visdom_plugin.integrations.nerfstudio.methods",
    "visdom_plugin.methods.radiance": "visdom_plugin.methods.fields.common",
    "visdom_plugin.nerf.volume": "visdom_plugin.nerf.rendering.volume",
}
"""Before, now. CHANGELOG.md lists all modules that moved, also those that no page named."""


class _OldPlaces(MetaPathFinder, Loader):
    """Puts the module of the new place under the name of the old one."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in MOVED else None

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(
            f"{name} is now {MOVED[name]}; the old name goes with version 0.3",
            DeprecationWarning,
            stacklevel=2,  # the import system's own frames are not counted
        )
        sys.modules[name] = import_module(MOVED[name])


def keep_old_places() -> None:
    """Lets old names be imported; called once, when `visdom_plugin` is."""
    sys.meta_path.insert(0, _OldPlaces())
