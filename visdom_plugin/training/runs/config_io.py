"""Config dataclasses to plain data and back, for YAML files and run.json."""

from __future__ import annotations

import types
from dataclasses import fields, is_dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from visdom_plugin.errors import ConfigError, did_you_mean, unknown_name

T = TypeVar("T")


def as_plain(value: Any) -> Any:
    """Dataclasses to dicts, tuples to lists, paths to text: what JSON and YAML can hold."""
    if is_dataclass(value):
        return {f.name: as_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(k): as_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(v) for v in value]
    return str(value) if isinstance(value, PurePath) else value


def from_plain(template: T, plain: Any, where: str, path: str = "") -> T:
    """A dataclass like `template` with the given fields replaced.

    Args:
        template: gives the class and the values of the fields that `plain` leaves out.
        plain: nested dict of field values, as `as_plain` makes it.
        where: the file the values come from, for error messages.
        path: name of the template inside the whole config, for error messages.

    Raises:
        ConfigError: for an unknown field (the valid ones are listed) or a value of the wrong type.
    """
    label = path or "the top level"
    if not isinstance(plain, dict):
        raise ConfigError(f"{label} must be a mapping, not {plain!r}", where=where)
    if not is_dataclass(template) or isinstance(template, type):
        raise TypeError(f"{label}: the template is no dataclass")
    valid = [f.name for f in fields(template) if f.init]
    hints = get_type_hints(type(template))
    changes = {}
    for name, value in plain.items():
        full = f"{path}.{name}" if path else str(name)
        if name not in valid:
            raise unknown_name(
                f"unknown setting {full!r}", name, valid, where=where, todo=f"valid names at {label}"
            )
        current = getattr(template, name)
        # A part of a hook may be switched on by its parts; a method without a hull or a hook stays without.
        if current is None and isinstance(value, dict) and path:
            current = _blank(hints[name])
        if is_dataclass(current) and isinstance(value, dict):
            changes[name] = from_plain(current, value, where, full)
            continue
        ok, changes[name] = _coerce(value, hints[name])
        if not ok:
            near = did_you_mean(value, _choices(hints[name]))
            raise ConfigError(
                f"{full} cannot be {value!r}{near}", where=where, todo=f"give {_spell(hints[name])}"
            )
    return replace(template, **changes)


def read_mapping(path: Path, what: str) -> dict[str, Any]:
    """The mapping that a YAML file holds; an empty file is an empty one.

    Args:
        what: the file, for error messages, e.g. "the config file".

    Raises:
        ConfigError: the file cannot be read, is not YAML, or holds something else.
    """
    import yaml

    try:
        # libyaml's parser, where it is there, takes a tenth of the time.
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=loader)
    except OSError as error:
        raise ConfigError(f"{what} cannot be read: {error.strerror}", where=path) from error
    except (yaml.YAMLError, ValueError) as error:
        # ValueError: no text, or a date that no calendar has.
        raise ConfigError(f"{what} is not YAML: {error}", where=path) from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{what} holds {type(content).__name__}, not settings", where=path)
    return {str(key): value for key, value in content.items()}


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """Where two plain values differ, one line each: "hull.k: 3 -> 2"."""
    if isinstance(a, dict) and isinstance(b, dict):
        lines = []
        for key in [*a, *(k for k in b if k not in a)]:
            name = f"{path}.{key}" if path else key
            lines += differences(a.get(key, _ABSENT), b.get(key, _ABSENT), name)
        return lines
    return [] if a == b else [f"{path}: {_short(a)} -> {_short(b)}"]


class _Absent:
    def __repr__(self) -> str:
        return "(absent)"


_ABSENT = _Absent()


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _blank(hint: Any) -> Any:
    """What a setting that is None is when given in parts: the defaults of its dataclass; None without one."""
    return next((arm() for arm in get_args(hint) if is_dataclass(arm) and isinstance(arm, type)), None)


def _coerce(value: Any, hint: Any) -> tuple[bool, Any]:
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return True, value
    if origin in (Union, types.UnionType):
        # The exact type first, so that k: int | str keeps 3 a number.
        for arm in sorted(args, key=lambda arm: arm is not type(value)):
            ok, result = _coerce(value, arm)
            if ok:
                return True, result
        return False, None
    if origin is Literal:
        return value in args and type(value) in {type(a) for a in args}, value
    if hint is type(None):
        return value is None, None
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            return False, None
        arms = args[:1] * len(value) if len(args) == 2 and args[1] is Ellipsis else args
        if len(arms) != len(value):
            return False, None
        parts = [_coerce(v, arm) for v, arm in zip(value, arms, strict=True)]
        return all(ok for ok, _ in parts), tuple(v for _, v in parts)
    if origin is dict:
        return isinstance(value, dict), value
    if hint is float:
        # YAML 1.1 reads 1e-3 as text.
        exponent = isinstance(value, str) and "e" in value.lower()
        if isinstance(value, bool) or not (exponent or isinstance(value, (int, float))):
            return False, None
        try:
            return True, float(value)
        except (ValueError, OverflowError):
            return False, None
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool), value
    if isinstance(hint, type) and issubclass(hint, PurePath):
        return isinstance(value, str), hint(value) if isinstance(value, str) else None
    if origin is None and isinstance(hint, type):
        return isinstance(value, hint), value
    return True, value


def _choices(hint: Any) -> list[Any]:
    """The values of a Literal, also of one among others, in which None counts as a value."""
    arms = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    if not all(get_origin(arm) is Literal or arm is type(None) for arm in arms):
        return []
    return [value for arm in arms for value in (get_args(arm) or (None,))]


def _spell(hint: Any) -> str:
    if _choices(hint):
        return "one of " + ", ".join(repr(a) for a in _choices(hint))
    if any(get_origin(part) is dict for part in (hint, *get_args(hint))):
        return "a mapping"
    return "a value of type " + (hint.__name__ if isinstance(hint, type) else str(hint))
