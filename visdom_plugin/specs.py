"""What a package says about its method: `MethodSpec`, from which the variants that people type are made.

Nothing heavy is imported here, and nothing of the method itself until `Preset.load`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from importlib import import_module
from typing import Any, ClassVar, Literal, Protocol

from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.hooks.configs import RegularizerConfig, SamplerConfig
from visdom_plugin.hull.domain import TRAINING_DOMAIN

HOOKS = {"sampler": SamplerConfig, "gaussian": RegularizerConfig}
"""By the hook a method takes, the settings of that hook."""
MEMBERS = ("setup", "train_step", "optimise", "render", "state_dict", "load_state_dict", "export")
"""What a method's class must offer; `training.protocols.Method` says what each does."""
MADE = {
    "mask": "with the silhouette loss",
    "vd": "in the visible domain: the hook, and the silhouette loss",
}
"""The variants that a method with a hook has, and what they say of themselves."""
MASK_WEIGHT = 0.1
"""The paper's weight of the silhouette loss."""


class Settings(Protocol):
    """A method's config: an instance of a dataclass, as `MethodSpec` asks for."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def check_requirements(config: object) -> None:
    """Asks a config that has such a method whether all is there that training takes from outside.

    Raises:
        PluginError, ConfigError: something is not, or is named wrongly.
    """
    check = getattr(config, "check_requirements", None)
    if check is not None:
        check()


@dataclass(frozen=True)
class Preset:
    """One variant of a method, as people type it, with its settings."""

    name: str
    """As typed after `method:`, e.g. "3dgs-go+vd"."""
    description: str
    """One line for lists and help."""
    target: str
    """Where the method's class is: "module:Class", constructed as Class(config)."""
    quick: Settings
    """Config dataclass for minutes on two CPU cores."""
    full: Settings
    """Config dataclass with the published schedule."""

    hook: str | None = None
    """"sampler" or "gaussian"; by default told by the settings in the config's field `vd`."""
    standard: Settings | None = None
    """Config dataclass for at most ten minutes on two CPU cores; None where there is nothing between the two."""
    standard_views: int = 0
    """Fewest views from which `standard` was seen to gain over `quick`."""

    def __post_init__(self) -> None:
        if self.hook is None:
            vd = getattr(self.quick, "vd", None)
            hook = next((name for name, settings in HOOKS.items() if isinstance(vd, settings)), None)
            object.__setattr__(self, "hook", hook)

    def settings(self, budget: str) -> Settings:
        """The config of a budget.

        Raises:
            ConfigError: the method has none for it.
        """
        if budget == "standard" and self.standard is None:
            raise ConfigError(
                f"method:{self.name} has no settings between quick and full",
                where="--budget standard",
                todo="give --budget quick or --budget full",
            )
        found: Settings = getattr(self, budget)
        return found

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
    fields of the config, which inherits them of `SamplerMethodConfig` or `GaussianMethodConfig`; the method reads

        config.mask_weight   0, and 0.1 in +mask and +vd: the weight of `losses.mask_loss(alpha, batch.mask)`
        config.hull          None, and the VisibleDomain to carve in +vd; the hull arrives in `setup`
        config.vd            the hook's settings, off but in +vd; the hook itself arrives in `setup(hooks=[...])`

    `visdom_plugin.hooks.protocols` says what the two kinds of hook do and what is expected of a method.

    Raises:
        PluginError: when something in it cannot be right.
    """

    name: str
    """As typed after `method:`, without a variant."""
    target: str
    """Where the method's class is: "module:Class", constructed as Class(config)."""
    quick: Settings
    """An instance of the method's own config dataclass: minutes on two CPU cores."""
    full: Settings = None  # type: ignore[assignment]  # `quick`, then
    """The same for the published schedule; by default `quick`."""
    hook: Literal["sampler", "gaussian"] | None = None
    """Which hook the method takes; None for none, and no variants."""
    description: str = ""
    """One line for lists and help."""
    variants: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """What a variant changes besides, by "mask" or "vd" and the config's field. A method without a hook has no
    other variants than those named here. "vd:NAME" is a variant of its own, `name+vd:NAME`: all that "vd" is, and
    these changes."""
    quick_variants: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """The same for the quick settings alone."""
    descriptions: Mapping[str, str] = field(default_factory=dict)
    """One line for a variant, in place of the one made from `description`."""
    standard: Settings | None = None
    """Settings between quick and full: at most ten minutes on two CPU cores at 400 x 400."""
    standard_views: int = 0
    """Fewest views from which `standard` was seen to gain over `quick`."""
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
        for budget in ("quick", "full", *(["standard"] if self.standard is not None else [])):
            config = getattr(self, budget)
            plain = is_dataclass(config) and not isinstance(config, type)
            shown = f"the class {config.__name__}" if isinstance(config, type) else type(config).__name__
            demand(plain, f"{budget} is {shown}", "give an instance of a dataclass, such as Config()")
        same = {type(self.quick), type(self.full), type(self.standard or self.quick)}
        demand(len(same) == 1, "quick and full are of different classes", "use one config dataclass for all")
        known = self.hook is None or self.hook in HOOKS
        demand(known, f"there is no hook {self.hook!r}", f"choose one of {', '.join(HOOKS)}, or None")
        names = {f.name for f in fields(self.quick)}
        if self.hook is not None:
            base = f"{self.hook.capitalize()}MethodConfig"
            lacks = [name for name in ("mask_weight", "hull", "vd") if name not in names]
            demand(
                not lacks,
                f"the config {type(self.quick).__name__} lacks {', '.join(lacks)}",
                f"let it inherit visdom_plugin.registry.{base}, which has mask_weight, hull and vd",
            )
            vd = getattr(self.quick, "vd", None)
            fits = isinstance(vd, HOOKS[self.hook]) or (
                type(vd) not in HOOKS.values() and hasattr(vd, "build")
            )
            demand(fits, f"the config's field vd is {type(vd).__name__}", f"use {HOOKS[self.hook].__name__}")
        for suffix, changes in (*self.variants.items(), *self.quick_variants.items()):
            fine = isinstance(suffix, str) and re.fullmatch(
                r"[A-Za-z0-9][\w.-]*(:[A-Za-z0-9][\w.-]*)?", suffix
            )
            demand(
                bool(fine) and (suffix.partition(":")[0] in MADE) == (self.hook is not None),
                f"there is no variant {suffix!r}",
                'variants are "mask" and "vd" of a method with a hook, and "mask:NAME" and "vd:NAME" that start '
                "from these; and any others of one without",
            )
            for name in changes:
                demand(name in names, f"variant {suffix!r} sets {name!r}, which the config lacks", "add it")

    def presets(self) -> dict[str, Preset]:
        """The variants by name, and by alias."""
        made: dict[str, Preset] = {}
        for suffix in dict.fromkeys(("", *(() if self.hook is None else MADE), *self.variants)):
            name = f"{self.name}+{suffix}" if suffix else self.name
            text = self.description
            if suffix:
                base, _, recipe = suffix.partition(":")
                made_up = f"{text or self.name}, {MADE.get(base, base)}" + (f", {recipe}" if recipe else "")
                text = self.descriptions.get(suffix, made_up)
            quick = self._vary(self.quick, suffix, self.variants, self.quick_variants)
            standard = None if self.standard is None else self._vary(self.standard, suffix, self.variants)
            full = self._vary(self.full, suffix, self.variants)
            made[name] = Preset(
                name, text, self.target, quick, full, self.hook, standard, self.standard_views
            )
        for alias in self.aliases:
            made |= {name.replace(self.name, alias, 1): p for name, p in list(made.items()) if name == p.name}
        return made

    def _vary(self, config: Settings, suffix: str, *varied: Mapping[str, Mapping[str, Any]]) -> Settings:
        """The settings of a variant; "vd:NAME" is what "vd" is and then its own changes, by each of `varied`."""
        changes: dict[str, object] = {}
        base, recipe, _ = suffix.partition(":")
        if base in MADE:
            changes["mask_weight"] = MASK_WEIGHT
        if base == "vd":
            changes["hull"] = TRAINING_DOMAIN
            vd = getattr(config, "vd", None)
            hook: Any = vd if is_dataclass(vd) else HOOKS[self.hook or ""]()
            changes["vd"] = replace(hook, enabled=True)
        for part in (base, suffix) if recipe else (base,):
            for variants in varied:
                changes |= variants.get(part, {})
        return replace(config, **changes)
