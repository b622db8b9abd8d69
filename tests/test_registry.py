"""Registration: by one door, all or nothing per package, and one bad package harms nobody else."""

from __future__ import annotations

import copy
import logging
import os
import pickle
import re
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from importlib.metadata import EntryPoint, entry_points
from typing import ClassVar

import pytest

from visdom_plugin.cli.methods_doctor import examine
from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.hooks.configs import RegularizerConfig, SamplerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.registry import (
    GROUP,
    GaussianMethodConfig,
    MethodSpec,
    Preset,
    Registry,
    SamplerMethodConfig,
    discover,
)
from visdom_plugin.training.runs.config_io import as_plain, from_plain


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
    assert len(warnings) == 1 and reason in warnings[0] and len(registry.skipped) == 1


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
    assert caught.value.todo == "choose one of: method:good, method:good+vd"
    assert caught.value.topic == "unknown-name"


def test_of_many_methods_the_error_says_where_they_are_listed():
    registry = Registry()
    registry.add([_preset(f"method{i}") for i in range(13)], "many")
    with pytest.raises(ConfigError) as caught:
        registry.find("methud5")
    assert "did you mean 'method5'?" in caught.value.what
    assert "visdom-methods" in caught.value.todo and "method7" not in str(caught.value)


def test_a_missing_class_names_the_method_and_the_target():
    broken = Preset("x", "", "tests.training.fake:Nothing", None, None)
    with pytest.raises(PluginError, match="method x cannot be loaded") as caught:
        broken.load()
    assert caught.value.where == "tests.training.fake:Nothing"


def test_the_built_in_methods_come_by_the_entry_point():
    values = {p.value for p in entry_points(group=GROUP) if p.dist and p.dist.name == "visdom-plugin"}
    assert "method_configs.gs_go:SPEC" in values
    found = discover()
    assert {"3dgs-go", "3dgs-go+mask", "3dgs-go+vd"} <= set(found.presets)
    for name, origin in found.origins.items():
        if origin == "visdom-plugin":
            preset = found.presets[name]
            assert preset.load() and preset.description and type(preset.quick) is type(preset.full)


@dataclass(frozen=True)
class Plain(SamplerMethodConfig):
    """A stranger's settings.

    Attributes:
        width: of the network.
    """

    width: int
    steps: int = 7


@dataclass(frozen=True)
class OwnWeight(GaussianMethodConfig):
    steps: int = 7
    mask_weight: float = 0.25
    """Its own."""


@dataclass
class Bare:
    """Without the fields in which variants differ."""

    steps: int = 7


TARGET = "tests.training.fake:FakeMethod"
SPEC = MethodSpec("mine", TARGET, Plain(3), full=Plain(64, steps=900), hook="sampler", aliases=("my",))


@pytest.mark.parametrize(
    ("hook", "config"), [("sampler", Plain(3)), ("gaussian", OwnWeight())], ids=["plain", "own weight"]
)
def test_a_method_that_says_its_hook_gets_all_variants_with_one_class_of_settings(hook, config):
    spec = MethodSpec("m", TARGET, config, hook=hook)
    bare, mask, vd = (spec.presets()[f"m{suffix}"].quick for suffix in ("", "+mask", "+vd"))
    assert type(bare) is type(mask) is type(vd) is type(config)
    for f in fields(config):
        if f.name not in ("mask_weight", "hull", "vd"):
            assert getattr(bare, f.name) == getattr(vd, f.name) == getattr(config, f.name)
    assert bare.mask_weight == config.mask_weight and mask.mask_weight == vd.mask_weight == 0.1
    assert bare.hull is mask.hull is None and isinstance(vd.hull, VisibleDomain)
    settings = {"sampler": SamplerConfig, "gaussian": RegularizerConfig}[hook]
    assert bare.vd == mask.vd == settings() and vd.vd == settings(enabled=True)
    assert {p.hook for p in spec.presets().values()} == {hook}


def test_settings_with_inherited_fields_are_data_as_any_other():
    bare, vd = (SPEC.presets()[name].full for name in ("mine", "mine+vd"))
    for twin in (
        copy.deepcopy(vd),
        pickle.loads(pickle.dumps(vd)),
        from_plain(vd, as_plain(vd), "here"),
    ):
        assert twin == vd and type(twin) is type(vd) and twin != bare
    assert MethodSpec("other", TARGET, Plain(3), hook="sampler").presets()["other"].quick == replace(
        bare, width=3, steps=7
    )


@dataclass(frozen=True)
class Strict(SamplerMethodConfig):
    """Checks itself."""

    steps: int = 7

    def __post_init__(self):
        super().__post_init__()
        if self.steps < 1:
            raise ConfigError("steps is below 1")


@dataclass(frozen=True)
class Dropping(Strict):
    """Says that its method drops single samples."""

    drops_samples: ClassVar[bool] = True


def test_dropping_samples_is_refused_where_the_method_does_not_say_that_it_does():
    on = SamplerConfig(enabled=True, drop_outside=True)
    for config in (Plain(3), Strict()):
        vd = MethodSpec("m", TARGET, config, hook="sampler").presets()["m+vd"].quick
        with pytest.raises(ConfigError, match="drop_outside") as caught:
            replace(vd, vd=on)
        assert caught.value.todo and type(config).__name__ in caught.value.where
        with pytest.raises(ConfigError, match="drop_outside"):
            from_plain(vd, as_plain(vd) | {"vd": as_plain(on)}, "here")
    preset = MethodSpec("m", TARGET, Dropping(), hook="sampler").presets()["m+vd"]
    assert replace(preset.quick, vd=on).vd.drop_outside


def test_virtual_views_are_refused_where_the_method_does_not_say_that_it_trains_them():
    asked = SamplerConfig(True, virtual_views="between")
    with pytest.raises(ConfigError, match="does not say that it trains their rays") as caught:
        Plain(3, hull=VisibleDomain(), vd=asked)
    assert "vd.virtual-views" in caught.value.where

    @dataclass(frozen=True)
    class Able(Plain):
        trains_empty_rays = True

    assert Able(3, hull=VisibleDomain(), vd=asked).vd == asked


def test_settings_with_inherited_fields_are_checked():
    for preset in MethodSpec("m", TARGET, Strict(), hook="sampler").presets().values():
        with pytest.raises(ConfigError, match="below 1"):
            replace(preset.quick, steps=0)
        with pytest.raises(ConfigError, match="mask_weight = -1"):
            replace(preset.quick, mask_weight=-1)
    for vd in (SamplerConfig(enabled=True), SamplerConfig(hull_at_inference=True)):
        with pytest.raises(ConfigError, match="no hull to go with it"):
            Strict(vd=vd)


def test_a_method_without_a_hook_stays_as_it_is():
    (preset,) = MethodSpec("m", TARGET, Bare()).presets().values()
    assert type(preset.quick) is Bare and preset.full == preset.quick and preset.hook is None


def test_a_method_without_a_hook_has_the_variants_it_names():
    spec = MethodSpec(
        "m", TARGET, Bare(), variants={"long": {"steps": 70}}, descriptions={"long": "more steps"}
    )
    presets = spec.presets()
    assert {name: p.quick.steps for name, p in presets.items()} == {"m": 7, "m+long": 70}
    assert presets["m+long"].description == "more steps"


def test_a_variant_may_change_the_quick_settings_alone():
    presets = replace(SPEC, variants={"vd": {"steps": 5}}, quick_variants={"vd": {"width": 2}}).presets()
    vd = presets["mine+vd"]
    assert (vd.quick.width, vd.full.width) == (2, 64) and vd.quick.steps == vd.full.steps == 5
    assert presets["mine"].quick.width == presets["mine+mask"].quick.width == 3


def test_settings_between_quick_and_full_have_their_variants():
    vd = replace(SPEC, standard=Plain(16, steps=50)).presets()["mine+vd"]
    assert (
        vd.settings("standard") == replace(vd.full, width=16, steps=50) and vd.settings("quick") == vd.quick
    )
    with pytest.raises(ConfigError, match=r"method:mine\+vd has no settings between"):
        SPEC.presets()["mine+vd"].settings("standard")


def test_variants_may_change_more_and_full_keeps_its_own():
    presets = replace(
        SPEC, variants={"vd": {"width": 5, "vd": SamplerConfig(True, missing="skip")}}
    ).presets()
    assert presets["mine+vd"].quick.width == presets["mine+vd"].full.width == 5
    assert presets["mine+vd"].quick.vd.missing == "skip" and presets["mine+mask"].quick.width == 3
    assert presets["mine+vd"].full.steps == 900 and presets["my+vd"] is presets["mine+vd"]


def test_a_recipe_is_all_that_its_variant_is_and_its_own_changes():
    spec = replace(
        SPEC,
        variants={"vd": {"steps": 50}, "vd:theirs": {"width": 5}, "mask:heavy": {"mask_weight": 2.0}},
        quick_variants={"vd": {"width": 4}, "vd:theirs": {"steps": 8}},
        descriptions={"vd:theirs": "as they run it"},
    )
    presets = spec.presets()
    assert [n for n in presets if n.startswith("mine")] == [
        "mine", "mine+mask", "mine+vd", "mine+vd:theirs", "mine+mask:heavy"
    ]  # fmt: skip
    vd, theirs = presets["mine+vd"], presets["mine+vd:theirs"]
    assert theirs.full == replace(vd.full, width=5) and theirs.quick == replace(vd.quick, width=5, steps=8)
    assert theirs.hook == "sampler" and theirs.description == "as they run it"
    assert (
        presets["mine+mask:heavy"].quick.mask_weight == 2.0
        and not presets["mine+mask:heavy"].quick.vd.enabled
    )
    assert presets["mine+mask:heavy"].description == "mine, with the silhouette loss, heavy"
    registry = Registry()
    registry.add(spec, "somewhere")
    assert registry.find("my+vd:theirs") is registry.find("mine+vd:theirs")


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"name": "a+vd"}, "'a+vd' is no name"),
        ({"name": 3}, "3 is no name"),
        ({"aliases": ("a b",)}, "'a b' is no name"),
        ({"target": "module.Class"}, "target is 'module.Class'"),
        ({"target": Plain}, "target is"),
        ({"quick": Plain}, "quick is the class Plain"),
        ({"full": {"steps": 3}}, "full is dict"),
        ({"full": OwnWeight()}, "different classes"),
        ({"standard": OwnWeight()}, "different classes"),
        ({"quick": Bare(), "full": None}, "Bare lacks mask_weight, hull, vd"),
        ({"hook": "gaussian"}, "field vd is SamplerConfig"),
        ({"quick_variants": {"vd": {"widht": 3}}}, "sets 'widht'"),
        ({"hook": "samplr"}, "no hook 'samplr'"),
        ({"variants": {"+vd": {}}}, "no variant '+vd'"),
        ({"variants": {"vd:": {}}}, "no variant 'vd:'"),
        ({"variants": {"bare:mine": {}}}, "no variant 'bare:mine'"),
        ({"variants": {"vd:mine": {"widht": 3}}}, "sets 'widht'"),
        ({"variants": {"vd": {"widht": 3}}}, "sets 'widht'"),
        ({"hook": None, "variants": {"vd": {}}}, "no variant 'vd'"),
    ],
)
def test_a_spec_that_cannot_be_right_says_what_and_what_to_do(changes, what):
    with pytest.raises(PluginError, match=re.escape(what)) as caught:
        replace(SPEC, **changes)
    assert caught.value.todo and "MethodSpec" in caught.value.where


def test_the_variable_names_code_that_is_not_installed_and_how_it_is_called(caplog):
    found = discover([], f" one={__name__}:SPEC, two = {__name__}:SPEC,three={__name__}:LIST,")
    # Both are called "my", too.
    assert set(found.presets) == {"one", "one+mask", "one+vd", "listed"} and len(found.skipped) == 1
    found = discover([], f"one={__name__}:LIST,{__name__}:SPEC,x={__name__},y=no_such_module_:X")
    assert set(found.presets) == {"listed"} and found.origins["listed"] == "VISDOM_METHODS"
    assert ["names no object" in s.reason for s in found.skipped] == [True, True, False]
    assert "PYTHONPATH" in found.skipped[2].todo
    with pytest.raises(ConfigError, match="skipped"):
        found.find("y")


def test_the_variable_cannot_take_a_name_either():
    found = discover([_point("a", f"{__name__}:ALIASED")], f"good={__name__}:SPEC")
    assert found.find("good") is A and "already has one" in found.skipped[0].reason


STRANGER = """
import {heavy}
from dataclasses import dataclass
from visdom_plugin.registry import MethodSpec, SamplerMethodConfig
@dataclass(frozen=True)
class Config(SamplerMethodConfig):
    steps: int = 3
SPEC = MethodSpec("strange", "heavy_method:Method", Config(), hook="sampler", description="A strange one")
"""


def _command(tmp_path, *words, **variables):
    environment = os.environ | {"PYTHONPATH": str(tmp_path)} | variables
    code = "import sys; from visdom_plugin.cli.commands.methods import main; sys.exit(main(sys.argv[1:]))"
    run = [sys.executable, "-c", code, *words]
    return subprocess.run(run, env=environment, capture_output=True, text=True, timeout=300)


def test_the_list_imports_no_method_and_the_doctor_tells_what_is_wrong_with_each(tmp_path):
    (tmp_path / "heavy_method.py").write_text("raise RuntimeError('loaded')\n")
    (tmp_path / "light.py").write_text(STRANGER.format(heavy="json"))
    (tmp_path / "slow.py").write_text(STRANGER.format(heavy="torch"))
    (tmp_path / "exits.py").write_text("import sys\nsys.exit('no licence')\n")
    variable = "light=light:SPEC,slow=slow:SPEC,gone=exits:SPEC"
    listed = _command(tmp_path, VISDOM_METHODS=variable)
    assert listed.returncode == 0, listed.stderr
    for name in ("method:light ", "method:light+vd ", "method:slow+mask ", "method:3dgs-go "):
        assert name in listed.stdout
    assert listed.stderr.count("\n") == 1 and "no licence" in listed.stderr
    doctor = _command(tmp_path, "--doctor", VISDOM_METHODS=variable).stdout
    assert "RuntimeError: loaded" in doctor and "method light cannot be loaded" in doctor
    assert (
        "listing VISDOM_METHODS (slow:SPEC)'s methods imports torch" in doctor
        and "(light:SPEC)'s" not in doctor
    )
    assert "(exits:SPEC) was skipped" in doctor and "sys.exit('no licence')" in doctor
    assert "importlib" not in doctor


def test_the_doctor_looks_for_slurm_and_other_hosts(tmp_path, monkeypatch):
    for name in ("sbatch", "sinfo"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    lines = examine(Registry())
    assert f"slurm: sbatch {tmp_path}/sbatch, sinfo {tmp_path}/sinfo" in lines
    monkeypatch.setenv("PATH", "")
    lines = examine(Registry())
    assert any(line.startswith("slurm: not found") for line in lines)
    for name in ("torch", "cuda", "gsplat", "opencv", "submitit", "nerfstudio", "nerfacc"):
        assert sum(line.startswith(f"{name}: ") for line in lines) == 1, name
