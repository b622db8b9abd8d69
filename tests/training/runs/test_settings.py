"""Config dataclasses survive the way to YAML or JSON and back; what is wrong in a file is said."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from visdom_plugin.errors import ConfigError
from visdom_plugin.training.runs.config_io import as_plain, differences, from_plain

_FLOATS = st.floats(allow_nan=False, allow_infinity=False)


@dataclass(frozen=True)
class Inner:
    k: int | str = 3
    box: tuple[tuple[float, float], ...] | None = None
    pair: tuple[float, int] = (0.5, 1)


@dataclass(frozen=True)
class Outer:
    rate: float = 1e-3
    steps: int = 10
    name: str = "a"
    active: bool = False
    kind: Literal["x", "y"] = "x"
    where: Path | None = None
    inner: Inner = field(default_factory=Inner)


_INNER = st.builds(
    Inner,
    k=st.integers() | st.text(),
    box=st.none() | st.lists(st.tuples(_FLOATS, _FLOATS)).map(tuple),
    pair=st.tuples(_FLOATS, st.integers()),
)
_OUTER = st.builds(
    Outer,
    rate=_FLOATS,
    steps=st.integers(),
    name=st.text(),
    active=st.booleans(),
    kind=st.sampled_from("xy"),
    where=st.none() | st.sampled_from([Path("a"), Path("/b/c d")]),
    inner=_INNER,
)


@given(_OUTER)
def test_json_and_yaml_give_back_the_same_config(config):
    for text, read in (
        (json.dumps(as_plain(config)), json.loads),
        (yaml.safe_dump(as_plain(config)), yaml.safe_load),
    ):
        assert from_plain(Outer(), read(text), "f") == config


@given(_OUTER, _OUTER)
def test_two_configs_differ_exactly_where_a_field_differs(a, b):
    lines = differences(as_plain(a), as_plain(b))
    assert (not lines) == (as_plain(a) == as_plain(b))
    assert differences(as_plain(a), as_plain(a)) == []
    named = {line.partition(":")[0] for line in lines}
    for name in ("rate", "steps", "name", "active", "kind"):
        assert (name in named) == (getattr(a, name) != getattr(b, name))


@dataclass(frozen=True)
class Maybe:
    inner: Inner | None = None
    rate: float | None = None


@dataclass(frozen=True)
class Hook:
    hook: Maybe = Maybe()


def test_a_part_of_a_hook_that_is_off_can_be_given_piece_by_piece():
    assert from_plain(Hook(), {"hook": {"inner": {"k": 7}}}, "f") == Hook(Maybe(inner=Inner(k=7)))
    assert from_plain(Hook(Maybe(inner=Inner(k=1))), {"hook": {"inner": None}}, "f") == Hook()
    with pytest.raises(ConfigError, match=r"unknown setting 'hook\.inner\.kk'"):
        from_plain(Hook(), {"hook": {"inner": {"kk": 7}}}, "f")
    with pytest.raises(ConfigError, match="rate cannot be"):
        from_plain(Maybe(), {"rate": {"k": 7}}, "f")


def test_a_method_without_a_hull_gets_none_by_a_setting_of_it():
    with pytest.raises(ConfigError, match="inner cannot be"):
        from_plain(Maybe(), {"inner": {"k": 7}}, "f.yaml")
    assert from_plain(Maybe(inner=Inner(k=1)), {"inner": None}, "f.yaml") == Maybe()


def test_fields_left_out_keep_the_templates_values():
    template = Outer(rate=0.5, inner=Inner(k="auto"))
    read = from_plain(template, yaml.safe_load("inner: {pair: [1, 2]}\nrate: 1e-4"), "f")
    assert read == Outer(rate=1e-4, inner=Inner(k="auto", pair=(1.0, 2)))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("stps: 3", r"unknown setting 'stps'[\s\S]*valid names at the top level: rate, steps, name"),
        ("inner: {kk: 3}", r"unknown setting 'inner.kk'[\s\S]*valid names at inner: k, box, pair"),
        ("steps: many", "steps cannot be 'many'"),
        ("steps: 2.5", r"steps cannot be 2\.5"),
        ("steps: true", "steps cannot be True"),
        ("rate: fast", "rate cannot be 'fast'"),
        (f"rate: 1{'0' * 400}", "rate cannot be 1000"),
        ("active: 1", "active cannot be 1"),
        ("kind: z", r"kind cannot be 'z'[\s\S]*one of 'x', 'y'"),
        ("inner: {pair: [1]}", r"inner\.pair cannot be \[1\]"),
        ("inner: 3", "inner cannot be 3"),
        ("- 1", "must be a mapping"),
    ],
)
def test_what_a_file_gets_wrong_is_said_with_its_place(text, says):
    with pytest.raises(ConfigError, match=says) as caught:
        from_plain(Outer(), yaml.safe_load(text), "my.yaml")
    assert caught.value.where == "my.yaml"
