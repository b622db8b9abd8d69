"""Methods by name. Built-in ones and a stranger's come in by the same door, the entry points `visdom.methods`.

An entry point names a `MethodSpec`, from which its variants are made, or presets given one by one; or a dict or
an iterable of either. A dictionary key that differs from its preset's own name is an alias. Code that is not
installed is named by the environment variable VISDOM_METHODS="name=module:attribute[,name=module:attribute]".
Nothing heavy is imported until a preset's method is loaded.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from visdom_plugin.errors import ConfigError, PluginError, did_you_mean
from visdom_plugin.hooks.configs import GaussianMethodConfig, SamplerMethodConfig
from visdom_plugin.specs import MethodSpec, Preset

__all__ = [
    "GROUP",
    "VARIABLE",
    "GaussianMethodConfig",
    "MethodSpec",
    "Preset",
    "Registry",
    "SamplerMethodConfig",
    "Skipped",
    "discover",
    "find",
    "installed",
]

GROUP = "visdom.methods"
VARIABLE = "VISDOM_METHODS"
HEAVY = ("torch", "numba", "cv2", "jax", "tensorflow", "nerfstudio", "gsplat")
"""What no package should import only to say its methods' names."""
OURS = "visdom-plugin"
_FEW = 12
"""Methods that an error lists; of more it says where they are listed."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Skipped:
    """A package whose methods could not be taken over."""

    origin: str
    """The package, or VISDOM_METHODS."""
    version: str | None
    """Of the package."""
    value: str
    """What was to be loaded, "module:attribute"."""
    reason: str
    """One line."""
    todo: str
    """What to do about it."""
    story: str
    """The traceback."""


@dataclass
class Registry:
    """Presets and aliases gathered so far."""

    presets: dict[str, Preset] = field(default_factory=dict)
    aliases: dict[str, str] = field(default_factory=dict)
    """Alias to preset name."""
    origins: dict[str, str] = field(default_factory=dict)
    """Preset name to the package that offers it."""
    skipped: list[Skipped] = field(default_factory=list)
    """Packages that could not be used."""
    slow: dict[str, tuple[float, list[str]]] = field(default_factory=dict)
    """Package to the seconds its names took and what heavy modules they imported, where there were any."""

    def add(self, offered: object, origin: str) -> None:
        """Takes over all presets of one package, or none.

        Args:
            offered: a MethodSpec or Preset, or a mapping or iterable of them.
            origin: the package.

        Raises:
            PluginError: for something that is neither, and for a name or alias that is taken.
        """
        presets: dict[str, Preset] = {}
        aliases: dict[str, str] = {}
        for key, preset in _pairs(offered, origin):
            if presets.setdefault(preset.name, preset) is not preset:
                raise PluginError(f"{origin} offers two presets of the name {preset.name!r}")
            if key != preset.name:
                aliases[key] = preset.name
        for name in (*presets, *aliases):
            if name in self.presets or name in self.aliases or (name in presets and name in aliases):
                owner = self.origins.get(self.aliases.get(name, name), origin)
                raise PluginError(
                    f"{origin} offers a method {name!r}, but {owner} already has one",
                    todo=f"rename it, or uninstall one of the two packages ({origin}, {owner})",
                )
        self.presets |= presets
        self.aliases |= aliases
        self.origins |= dict.fromkeys(presets, origin)

    def find(self, name: str) -> Preset:
        """The preset of a name or alias.

        Raises:
            ConfigError: for an unknown name, with the nearest one.
        """
        base, plus, variant = name.partition("+")
        for known in (name, self.aliases.get(base, base) + plus + variant):
            if (known := self.aliases.get(known, known)) in self.presets:
                return self.presets[known]
        if not self.presets:
            raise ConfigError(
                f"there is no method {name!r}: no method at all is registered",
                cause="the package is run without being installed, or was installed by an older version",
                todo="pip install -e . (or pip install visdom-plugin)",
            )
        skipped = ", ".join(s.origin for s in self.skipped)
        names = [*self.presets, *self.aliases]
        raise ConfigError(
            f"there is no method {name!r}{did_you_mean(name, names)}",
            cause=f"the methods of a package were skipped; `visdom-methods --doctor` tells why: {skipped}"
            if skipped
            else None,
            todo=f"choose one of: {', '.join(f'method:{n}' for n in self.presets)}"
            if len(names) <= _FEW
            else "choose one of those that `visdom-methods` lists",
            topic="unknown-name",
        )


def _pairs(offered: object, origin: str) -> list[tuple[str, Preset]]:
    """Names and presets of whatever a package offers."""
    if isinstance(offered, MethodSpec):
        return list(offered.presets().items())
    if isinstance(offered, Preset):
        return [(offered.name, offered)]
    if isinstance(offered, Mapping):
        items = list(offered.items())
    elif isinstance(offered, Iterable) and not isinstance(offered, (str, type)):
        items = [(None, item) for item in offered]
    else:
        items = [(None, offered)]
    found: list[tuple[str, Preset]] = []
    for key, item in items:
        if isinstance(item, Preset):
            found.append((item.name if key is None else key, item))
        elif isinstance(item, MethodSpec):
            made = list(item.presets().items())
            found += made
            if key not in (None, item.name):
                found += [(name.replace(item.name, key, 1), p) for name, p in made if name == p.name]
        else:
            shown = f"the class {item.__name__}" if isinstance(item, type) else type(item).__name__
            raise PluginError(
                f"{origin} offers {shown}, not a MethodSpec",
                todo=f"point its {GROUP!r} entry point at a visdom_plugin.registry.MethodSpec, or a dict or list "
                "of them",
            )
    return found


def discover(points: Iterable[EntryPoint] | None = None, variable: str | None = None) -> Registry:
    """Loads every entry point of the group; one that fails is skipped with a warning.

    Args:
        points: entry points to load instead of the installed ones.
        variable: what to read instead of VISDOM_METHODS; nothing by default where `points` are given.
    """
    found = Registry()
    if variable is None:
        variable = os.environ.get(VARIABLE, "") if points is None else ""
    points = entry_points(group=GROUP) if points is None else points
    # Our own come first, so that nobody can take their names; the rest in a fixed order.
    for point in sorted(points, key=lambda p: (_origin(p) != OURS, _origin(p), p.name)):
        _take(found, point, _origin(point))
    for part in filter(None, (p.strip() for p in variable.split(","))):
        name, _, value = (x.strip() for x in part.partition("="))
        _take(found, EntryPoint(name, value, GROUP), VARIABLE)
    return found


def _take(found: Registry, point: EntryPoint, origin: str) -> None:
    before, began = set(sys.modules), time.perf_counter()
    try:
        if origin == VARIABLE and not (point.name and re.fullmatch(r"[\w.]+:[\w.]+", point.value)):
            raise PluginError(
                f"{point.name!r} is given as {point.value!r}, which names no object",
                todo='write "name=module:attribute"; several with commas between',
            )
        offered = point.load()
        if origin == VARIABLE and isinstance(offered, MethodSpec):
            # The one who sets the variable says what it is called, so that two versions can stand side by side.
            offered = replace(offered, name=point.name)
        found.add(offered, origin)
    except (Exception, SystemExit) as error:
        skipped = _explain(error, point, origin)
        found.skipped.append(skipped)
        log.warning(
            "methods of %s (%s) are skipped: %s (the full story: visdom-methods --doctor)",
            *(origin, point.value, skipped.reason),
        )
    heavy = [name for name in HEAVY if name in sys.modules and name not in before]
    if heavy and origin != OURS:
        found.slow[f"{origin} ({point.value})"] = time.perf_counter() - began, heavy


def _explain(error: BaseException, point: EntryPoint, origin: str) -> Skipped:
    reason = error.what if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
    lookup = f"see that {point.value.partition(':')[0]} can be imported and is of a version that fits"
    if isinstance(error, PluginError) and error.todo:
        todo = error.todo
    elif origin == VARIABLE:
        todo = (
            f"{lookup}; code that is not installed is found where PYTHONPATH points: export PYTHONPATH=FOLDER"
        )
    else:
        todo = f"{lookup}: pip install --upgrade {origin}, or do without it: pip uninstall {origin}"
    return Skipped(
        origin,
        point.dist.version if point.dist is not None else None,
        point.value,
        " ".join(reason.split()),
        todo,
        tell(error),
    )


def tell(error: BaseException) -> str:
    """The traceback of an error and of what caused it, without the import system's own frames."""
    told = traceback.TracebackException.from_exception(error)
    part: traceback.TracebackException | None = told
    while part is not None:
        kept = [f for f in part.stack if "importlib" not in f.filename and f.filename != __file__]
        part.stack = traceback.StackSummary.from_list(kept)
        part = part.__cause__ or part.__context__
    return "".join(told.format()).rstrip()


@cache
def installed() -> Registry:
    """The registry of this environment, built once per process."""
    return discover()


def find(name: str) -> Preset:
    """The installed preset of a name or alias; see `Registry.find`."""
    return installed().find(name)


def _origin(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
