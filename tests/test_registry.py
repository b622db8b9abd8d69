"""Registration: by entry points alone, all or nothing per package, and one bad package harms nobody else."""

from __future__ import annotations

import logging
from importlib.metadata import EntryPoint, entry_points

import pytest

from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.registry import GROUP, Preset, Registry, discover


def _preset(name: str) -> Preset:
    return Preset(name, f"about {name}", "tests.training.fake:FakeMethod", None, None)


GOOD = {"good": _preset("good"), "fine": _preset("good")}
A = _preset("good")
ALIASED = {"good": A, "fine": A, "good+vd": _preset("good+vd")}
LIST = [_preset("listed")]
TAKEN = [_preset("unique"), _preset("good")]
NONSENSE = 3


def _point(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, GROUP)


def test_a_dict_and_a_list_are_registered_with_aliases_also_for_variants():
    found = discover([_point("a", f"{__name__}:ALIASED"), _point("b", f"{__name__}:LIST")])
    assert list(found.presets) == ["good", "good+vd", "listed"]
    assert found.find("fine") is found.find("good") is A
    assert found.find("fine+vd") is ALIASED["good+vd"]
    assert found.find("good").load().__name__ == "FakeMethod"


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("tests.no_such_module:X", "ModuleNotFoundError"),
        (f"{__name__}:NO_SUCH_NAME", "AttributeError"),
        (f"{__name__}:NONSENSE", "int"),
        (f"{__name__}:TAKEN", "'good'"),
        (f"{__name__}:GOOD", "'good'"),
    ],
)
def test_a_broken_package_is_skipped_whole_with_one_warning_naming_it(value, reason, caplog):
    points = [_point("a", f"{__name__}:ALIASED"), _point("b", value), _point("c", f"{__name__}:LIST")]
    with caplog.at_level(logging.WARNING):
        registry = discover(points)
    assert "listed" in registry.presets and "unique" not in registry.presets
    warnings = [r.getMessage() for r in caplog.records]
    assert len(warnings) == 1 and reason in warnings[0] and len(registry.broken) == 1


def test_a_name_cannot_be_taken_twice_not_even_as_an_alias():
    registry = Registry()
    registry.add(ALIASED, "first")
    for offered in ([_preset("good")], [_preset("fine")], {"good": _preset("other")}):
        with pytest.raises(PluginError, match=r"second offers .* first already has one"):
            registry.add(offered, "second")
    assert set(registry.presets) == {"good", "good+vd"}


def test_a_typo_gets_the_nearest_name_and_all_names():
    registry = Registry()
    registry.add(ALIASED, "first")
    with pytest.raises(ConfigError) as caught:
        registry.find("goud")
    assert "did you mean 'good'?" in caught.value.what
    assert caught.value.todo == "choose one of: method:good, method:good+vd, method:fine"


def test_a_missing_class_names_the_method_and_the_target():
    broken = Preset("x", "", "tests.training.fake:Nothing", None, None)
    with pytest.raises(PluginError, match="method x cannot be loaded") as caught:
        broken.load()
    assert caught.value.where == "tests.training.fake:Nothing"


def test_the_built_in_methods_come_by_the_entry_point():
    values = {p.value for p in entry_points(group=GROUP) if p.dist and p.dist.name == "visdom-plugin"}
    assert "method_configs.gs_go:PRESETS" in values
    found = discover()
    assert {"3dgs-go", "3dgs-go+mask", "3dgs-go+vd"} <= set(found.presets)
    for name, origin in found.origins.items():
        if origin == "visdom-plugin":
            preset = found.presets[name]
            assert preset.load() and preset.description and type(preset.quick) is type(preset.full)
