"""Methods by name. Built-in ones and a stranger's come in by the same door, the entry points `visdom.methods`.

An entry point names a dict of presets or an iterable of them. A dictionary key that differs from its
preset's own name is an alias. Nothing heavy is imported until a preset's method is loaded.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from visdom_plugin.errors import ConfigError, PluginError

GROUP = "visdom.methods"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Preset:
    """A named method with its settings."""

    name: str
    """As typed after `method:`, e.g. "3dgs-go+vd"."""
    description: str
    """One line for lists and help."""
    target: str
    """Where the method's class is: "module:Class", constructed as Class(config)."""
    quick: Any
    """Config dataclass for minutes on two CPU cores."""
    full: Any
    """Config dataclass with the published schedule."""

    def load(self) -> type:
        """Imports the method's class.

        Raises:
            PluginError: when the module or the class is not there.
        """
        module, _, attribute = self.target.partition(":")
        try:
            return getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise PluginError(
                f"method {self.name} cannot be loaded: {error}",
                where=self.target,
                todo="reinstall the package that offers it; `visdom-methods --doctor` shows what is found",
            ) from error


@dataclass
class Registry:
    """Presets and aliases gathered so far."""

    presets: dict[str, Preset] = field(default_factory=dict)
    aliases: dict[str, str] = field(default_factory=dict)
    """Alias to preset name."""
    origins: dict[str, str] = field(default_factory=dict)
    """Preset name to the package that offers it."""
    broken: dict[str, str] = field(default_factory=dict)
    """Package to the reason why it was skipped."""

    def add(self, offered: Mapping[str, Preset] | Iterable[Preset], origin: str) -> None:
        """Takes over all presets of one package, or none.

        Raises:
            PluginError: for something that is no preset, and for a name or alias that is taken.
        """
        if isinstance(offered, Mapping):
            pairs = list(offered.items())
        elif isinstance(offered, Iterable) and not isinstance(offered, str):
            pairs = [(getattr(preset, "name", ""), preset) for preset in offered]
        else:
            pairs = [("", offered)]
        presets: dict[str, Preset] = {}
        aliases: dict[str, str] = {}
        for key, preset in pairs:
            if not isinstance(preset, Preset):
                raise PluginError(
                    f"{origin} offers {type(preset).__name__}, not a Preset",
                    todo=f"point its {GROUP!r} entry point at a dict or list of visdom_plugin.registry.Preset",
                )
            if presets.setdefault(preset.name, preset) is not preset:
                raise PluginError(f"{origin} offers two presets of the name {preset.name!r}")
            if key != preset.name:
                aliases[key] = preset.name
        for name in (*presets, *aliases):
            if name in self.presets or name in self.aliases or (name in presets and name in aliases):
                owner = self.origins.get(self.aliases.get(name, name), origin)
                raise PluginError(f"{origin} offers a method {name!r}, but {owner} already has one")
        self.presets |= presets
        self.aliases |= aliases
        self.origins |= dict.fromkeys(presets, origin)

    def find(self, name: str) -> Preset:
        """The preset of a name or alias.

        Raises:
            ConfigError: for an unknown name, with the nearest and all available ones.
        """
        base, plus, variant = name.partition("+")
        for known in (name, self.aliases.get(base, base) + plus + variant):
            if (known := self.aliases.get(known, known)) in self.presets:
                return self.presets[known]
        near = difflib.get_close_matches(name, [*self.presets, *self.aliases], 1, 0.5)
        if not self.presets:
            raise ConfigError(
                f"there is no method {name!r}: no method at all is registered",
                cause="the package is run without being installed, or was installed by an older version",
                todo="pip install -e . (or pip install visdom-plugin)",
            )
        raise ConfigError(
            f"there is no method {name!r}" + (f"; did you mean {near[0]!r}?" if near else ""),
            todo="choose one of: " + ", ".join(f"method:{n}" for n in [*self.presets, *self.aliases]),
        )


def discover(points: Iterable[EntryPoint] | None = None) -> Registry:
    """Loads every entry point of the group; one that fails is skipped with a warning.

    Args:
        points: entry points to load instead of the installed ones.
    """
    found = Registry()
    points = entry_points(group=GROUP) if points is None else points
    # Our own come first, so that nobody can take their names; the rest in a fixed order.
    for point in sorted(points, key=lambda p: (_origin(p) != "visdom-plugin", _origin(p), p.name)):
        origin = _origin(point)
        try:
            found.add(point.load(), origin)
        except Exception as error:
            reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
            found.broken[f"{origin} ({point.value})"] = reason
            log.warning("methods of package %s (%s) are skipped: %s", origin, point.value, reason)
    return found


@cache
def installed() -> Registry:
    """The registry of this environment, built once per process."""
    return discover()


def find(name: str) -> Preset:
    """The installed preset of a name or alias; see `Registry.find`."""
    return installed().find(name)


def _origin(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
