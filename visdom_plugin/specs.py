"""What a package says about its method: `MethodSpec`, from which the variants that people type are made.

Nothing heavy is imported here, and nothing of the method itself until `Preset.load`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import cache
from importlib import import_module
from typing import Any, Literal

from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.hooks.configs import RegularizerConfig, SamplerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN, VisibleDomain

HOOKS = {"sampler": SamplerConfig, "gaussian": RegularizerConfig}
"""By the hook a method takes, the settings of that hook."""
MEMBERS = ("setup", "train_step", "optimise", "render", "state_dict", "load_state_dict", "export")
"""What a method's class must offer; `training.protocols.Method` says what each does."""
MASK_WEIGHT = 0.1
"""The paper's weight of the silhouette loss."""


@dataclass(frozen=True)
class Preset:
    """One variant of a method, as people type it, with its settings."""

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

    hook: str | None = None
    """"sampler" or "gaussian"; by default told by the settings in the config's field `vd`."""

    def __post_init__(self) -> None:
        if self.hook is None:
            vd = getattr(self.quick, "vd", None)
            hook = next((name for name, settings in HOOKS.items() if isinstance(vd, settings)), None)
            object.__setattr__(self, "hook", hook)

    def load(self) -> type:
        """Imports the method's class.

        Raises:
            PluginError: when the module fails, or what it holds there is no method.
        """
        module, _, attribute = self.target.partition(":")
        try:
            found = getattr(import_module(module), attribute)
        except (Exception, SystemExit) as error:
            reason = f"{error}" if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
            raise PluginError(
                f"method {self.name} cannot be loaded: {reason}",
                where=self.target,
                todo="reinstall the package that offers it; `visdom-methods --doctor` shows the full story",
            ) from error
        missing = [m for m in MEMBERS if isinstance(found, type) and not callable(getattr(found, m, None))]
        if not callable(found) or missing:
            lacks = f"lacks {', '.join(missing)}" if missing else f"is {type(found).__name__}, not a class"
            raise PluginError(
                f"method {self.name} cannot be used: {attribute} {lacks}",
                where=self.target,
                todo="see visdom_plugin.training.protocols.Method for what a method offers",
            )
        return found


@dataclass(frozen=True)
class MethodSpec:
    """A method, and which hook it takes. The entry point of group `visdom.methods` names one:

        [project.entry-points."visdom.methods"]
        my-method = "my_method.spec:SPEC"

    Its module should import nothing heavy: it is read by every `visdom-train --help`. The class behind `target`
    is imported when it is trained.

    With a hook, the method comes in three variants: `name`, `name+mask` and `name+vd`. They differ in three
    fields of the config. A config that does not have them gets them, by way of a subclass, so that all variants
    are constructed with the same class; the method reads

        config.mask_weight   0, and 0.1 in +mask and +vd: the weight of `losses.mask_loss(alpha, batch.mask)`
        config.hull          None, and the VisibleDomain to carve in +vd; the hull arrives in `setup`
        config.vd            the hook's settings, off but in +vd; the hook itself arrives in `setup(hooks=[...])`

    Single samples few methods drop: `vd.drop_outside` is refused, unless the config has a field `vd` of its own.
    `visdom_plugin.hooks.protocols` says what the two kinds of hook do and what is expected of a method.

    Raises:
        PluginError: when something in it cannot be right.
    """

    name: str
    """As typed after `method:`, without a variant."""
    target: str
    """Where the method's class is: "module:Class", constructed as Class(config)."""
    quick: Any
    """An instance of the method's own config dataclass: minutes on two CPU cores."""
    full: Any = None
    """The same for the published schedule; by default `quick`."""
    hook: Literal["sampler", "gaussian"] | None = None
    """Which hook the method takes; None for none, and no variants."""
    description: str = ""
    """One line for lists and help."""
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """What a variant changes besides, by "mask" or "vd" and the config's field."""
    aliases: tuple[str, ...] = ()
    """Other names for it."""

    def __post_init__(self) -> None:
        where = f"MethodSpec {self.name!r}"

        def demand(holds: bool, what: str, todo: str) -> None:
            if not holds:
                raise PluginError(what, where=where, todo=todo)

        for name in (self.name, *self.aliases):
            fine = isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9][\w.-]*", name)
            demand(bool(fine), f"{name!r} is no name", "use letters, digits, dots, dashes; variants add a +")
        target = isinstance(self.target, str) and re.fullmatch(r"[\w.]+:\w+", self.target)
        demand(bool(target), f"target is {self.target!r}", 'write "module:Class", as text')
        if self.full is None:
            object.__setattr__(self, "full", self.quick)
        for budget in ("quick", "full"):
            config = getattr(self, budget)
            plain = is_dataclass(config) and not isinstance(config, type)
            shown = f"the class {config.__name__}" if isinstance(config, type) else type(config).__name__
            demand(plain, f"{budget} is {shown}", "give an instance of a dataclass, such as Config()")
        same = type(self.quick) is type(self.full)
        demand(same, "quick and full are of different classes", "use one config dataclass for both")
        known = self.hook is None or self.hook in HOOKS
        demand(known, f"there is no hook {self.hook!r}", f"choose one of {', '.join(HOOKS)}, or None")
        if self.hook is not None:
            vd = getattr(self.quick, "vd", None)
            fits = vd is None or isinstance(vd, HOOKS[self.hook]) or hasattr(vd, "build")
            demand(
                fits,
                f"the config's field vd is {type(vd).__name__}",
                f"use {HOOKS[self.hook].__name__}, or none",
            )
        for suffix, changes in self.variants.items():
            demand(
                suffix in ("mask", "vd") and self.hook is not None,
                f"there is no variant {suffix!r}",
                'variants are "mask" and "vd", of a method with a hook',
            )
            names = {f.name for f in fields(self._extend(self.quick))}
            for name in changes:
                demand(name in names, f"variant {suffix!r} sets {name!r}, which the config lacks", "add it")

    def presets(self) -> dict[str, Preset]:
        """The variants by name, and by alias."""
        bare = Preset(
            self.name,
            self.description,
            self.target,
            self._extend(self.quick),
            self._extend(self.full),
            self.hook,
        )
        made = {self.name: bare}
        if self.hook is not None:
            texts = {
                "mask": "with the silhouette loss",
                "vd": "in the visible domain: the hook, and the silhouette loss",
            }
            for suffix, text in texts.items():
                configs = (self._change(config, suffix) for config in (bare.quick, bare.full))
                name = f"{self.name}+{suffix}"
                what = f"{self.description or self.name}, {text}"
                made[name] = Preset(name, what, self.target, *configs, self.hook)
        for alias in self.aliases:
            made |= {name.replace(self.name, alias, 1): p for name, p in list(made.items()) if name == p.name}
        return made

    def _extend(self, config: Any) -> Any:
        if self.hook is None:
            return config
        values = {f.name: getattr(config, f.name) for f in fields(config) if f.init}
        try:
            return extend(type(config), self.hook)(**values)
        except TypeError as error:
            raise PluginError(
                f"the config {type(config).__name__} cannot be given the fields mask_weight, hull and vd: {error}",
                where=f"MethodSpec {self.name!r}",
                todo="make it a plain dataclass, or give it these three fields",
            ) from error

    def _change(self, config: Any, suffix: str) -> Any:
        changes: dict[str, Any] = {"mask_weight": MASK_WEIGHT}
        if suffix == "vd":
            changes["hull"] = TRAINING_DOMAIN
            changes["vd"] = replace(HOOKS[self.hook](), enabled=True)
            if is_dataclass(config.vd):
                changes["vd"] = replace(config.vd, enabled=True)
        return replace(config, **changes | dict(self.variants.get(suffix, {})))


@cache
def extend(config_class: type, hook: str) -> type:
    """The config class with the fields that the variants set; the class itself where it has them all.

    Instances of the result are instances of `config_class`, can be pickled, and are constructed alike. With a
    field `vd` that is added, they refuse `drop_outside`, which needs more of a method than to bound its rays.
    """
    own = {f.name for f in fields(config_class)}
    settings = HOOKS[hook]
    offered = (
        ("mask_weight", float, field(default=0.0)),
        ("hull", VisibleDomain | None, field(default=None)),
        ("vd", settings, field(default=settings())),
    )
    added = [item for item in offered if item[0] not in own]
    if not added:
        return config_class

    def check(self: Any, *rest: Any) -> None:
        if hasattr(config_class, "__post_init__"):
            config_class.__post_init__(self, *rest)
        if "vd" not in own and getattr(self.vd, "drop_outside", False):
            raise ConfigError(
                "vd.drop_outside is on, but the method does not say that it drops single samples",
                where=f"{config_class.__name__}, --method.vd.drop-outside",
                todo="leave it off, or train method:vaxnerf; a method that asks the hook's keep() about each "
                "sample says so by a field vd: SamplerConfig in its config",
            )

    documents = {
        "mask_weight": "Weight of the binary cross entropy between rendered opacity and mask.",
        "hull": "The hull of the visible-domain hook; carved when there is one.",
        "vd": "The visible-domain hook.",
    }
    extended = make_dataclass(
        config_class.__name__,
        added,
        bases=(config_class,),
        frozen=config_class.__dataclass_params__.frozen,
        kw_only=True,
        namespace={
            "__post_init__": check,
            "__reduce__": lambda self: (
                _rebuild,
                (config_class, hook, {f.name: getattr(self, f.name) for f in fields(self) if f.init}),
            ),
        },
    )
    extended.__module__, extended.__qualname__ = config_class.__module__, config_class.__qualname__
    head = (config_class.__doc__ or f"{config_class.__name__}.").rstrip()
    lines = "".join(f"\n        {name}: {documents[name]}" for name, *_ in added)
    extended.__doc__ = f"{head}\n\n    Attributes:{lines}\n"
    return extended


def _rebuild(config_class: type, hook: str, values: dict[str, Any]) -> Any:
    return extend(config_class, hook)(**values)
