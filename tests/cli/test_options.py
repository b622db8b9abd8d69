"""Preset, then file, then command line; and nothing leaks from one method to another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.training.fake import FASTER, PRESET, FakeConfig, FakeInner
from visdom_plugin.cli import options
from visdom_plugin.cli.commands import check, hull
from visdom_plugin.cli.early import Early, read_early
from visdom_plugin.errors import ConfigError


@pytest.fixture(autouse=True)
def _fakes(fakes):
    return fakes


def _parse(*words: str) -> options.Request:
    return options.parse(words)


@pytest.mark.parametrize("preset", [PRESET, FASTER])
@pytest.mark.parametrize("budget", ["quick", "full"])
def test_each_method_and_budget_has_its_own_defaults(preset, budget):
    asked = _parse(f"method:{preset.name}", "--budget", budget)
    assert asked.preset is not None and asked.preset.name == preset.name
    assert asked.config == getattr(preset, budget) and type(asked.config) is FakeConfig


def test_a_budget_between_quick_and_full_is_for_methods_that_have_one(monkeypatch):
    with pytest.raises(ConfigError, match="method:fake has no settings between quick and full") as caught:
        _parse("method:fake", "--budget", "standard")
    assert caught.value.todo == "give --budget quick or --budget full"
    between = replace(PRESET, standard=FakeConfig(steps=60))
    asked = options.parse(["method:fake", "--budget", "standard"], find=lambda name: between)
    assert asked.config == FakeConfig(steps=60) and asked.common.budget == "standard"
    assert asked.note == "budget standard"


def test_an_alias_is_the_method_itself():
    assert _parse("method:pretend").preset is _parse("method:fake").preset


def test_options_stand_on_either_side_of_the_method():
    words = ["--views", "6", "--method.lr", "0.25", "--quiet"]
    asked = [_parse(*words[:n], "method:fake", *words[n:]) for n in (0, 2, 4, 5)]
    assert all(a == asked[0] for a in asked)
    assert asked[0].common.views == 6 and asked[0].config == FakeConfig(lr=0.25) and asked[0].common.quiet


def test_auto_budget_follows_the_device_and_says_so(monkeypatch):
    cpu = _parse("method:fake", "--device", "cpu")
    assert cpu.common.budget == "quick" and cpu.note == "budget quick, chosen for device cpu"
    cuda = _parse("--device=cuda", "method:fake")
    assert cuda.common.budget == "full" and cuda.config == PRESET.full
    assert _parse("method:fake", "--device=cuda", "--budget=quick").config == PRESET.quick


def test_the_command_line_beats_the_file_and_the_file_beats_the_preset(tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text("budget: full\nviews: 9\nseed: 4\nsettings:\n  lr: 0.125\n  inner:\n    weight: 0.75\n")
    asked = _parse("method:fake", "--config", str(path), "--method.inner.weight", "1.5", "--seed", "8")
    assert asked.config == FakeConfig(steps=80, lr=0.125, inner=FakeInner(weight=1.5))
    assert (asked.common.views, asked.common.seed, asked.common.budget) == (9, 8, "full")
    assert f"2 settings changed by {path}" in asked.note


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(["fake", "fake+fast"]),
    st.sampled_from(["quick", "full"]),
    st.integers(1, 10**6),
    st.floats(1e-12, 1e6),
    st.integers(2, 64),
)
def test_show_config_round_trips(tmp_path, name, budget, steps, lr, views):
    words = ["--budget", budget, "--method.steps", str(steps), "--method.lr", repr(lr), "--views", str(views)]
    first = _parse(f"method:{name}", *words, "--data", "/some where/ünï")
    path = tmp_path / "shown.yaml"
    path.write_text(options.dump(first), encoding="utf-8")
    for again in (_parse("--config", str(path)), _parse(f"method:{name}", f"--config={path}")):
        assert options.dump(again) == options.dump(first)
        assert again.config == first.config
        assert replace(again.common, config=None) == first.common
    assert first.common.data == Path("/some where/ünï")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "stps: 3",
            r"unknown setting 'stps'[\s\S]*method, data, views, downscale, seed, missing_masks, .*, settings",
        ),
        ("settings: {stps: 3}", r"unknown setting 'settings.stps'[\s\S]*valid names at settings: steps, lr"),
        ("settings: {inner: {w: 3}}", r"'settings.inner.w'[\s\S]*settings.inner: weight"),
        ("settings: {lr: soon}", "settings.lr cannot be 'soon'"),
        ("views: four", "views cannot be 'four'"),
        ("budget: huge", r"budget cannot be 'huge'[\s\S]*'auto', 'quick', 'standard', 'full'"),
        ("method: fake+fast", "is for method:fake\\+fast, the command line says method:fake"),
        ("method: nothing", "no method 'nothing'"),
        ("[1, 2]", "holds list"),
        ("a: [", "not YAML"),
        ("\x00", "not YAML"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, text, says):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        _parse("method:fake", "--config", str(path))


def test_a_missing_or_unreadable_file_is_said(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        _parse("method:fake", "--config", "none.yaml")
    with pytest.raises(ConfigError, match="directory"):
        _parse("method:fake", "--config", str(tmp_path))
    (tmp_path / "x.png").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ConfigError, match="not YAML"):
        _parse("method:fake", "--config", "x.png")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            [],
            r"no method is named[\s\S]*visdom-train method:zipnerf\+vd[\s\S]*: method:fake, method:fake\+fast",
        ),
        (["--quiet", "fake"], r"named with method: before it[\s\S]*visdom-train method:fake"),
        (["method:fke"], r"no method 'fke'; did you mean 'fake'\?[\s\S]*method:fake, method:fake\+fast"),
        (["method:fake", "method:fake+fast"], "one method at a time"),
    ],
)
def test_a_missing_or_mistyped_method_lists_the_methods(words, says):
    with pytest.raises(ConfigError, match=says):
        _parse(*words)


def test_cuda_where_there_is_none_is_said(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert options.resolve_device("auto") == options.resolve_device("cpu") == "cpu"
    with pytest.raises(ConfigError, match="no CUDA device"):
        options.resolve_device("cuda")


def test_one_early_parse_knows_what_decides_the_rest():
    words = ["--views", "6", "method:a+vd", "--config=a b.yaml", "--device", "cpu", "--device=cuda", "-h"]
    early = read_early(words)
    assert early.methods == ("a+vd",) and early.rest == (*words[:2], *words[3:])
    assert (early.config, early.budget, early.device, early.quiet) == ("a b.yaml", None, "cuda", False)
    assert early.help and not read_early(words[:-1]).help
    # An option without its value is left to the real parser.
    assert read_early(["--quiet", "--config"]) == Early((), ("--quiet", "--config"), quiet=True)


@pytest.mark.parametrize("command", [check, hull])
def test_commands_that_look_at_a_scene_have_the_options_of_training(command, capsys):
    common = options.SceneOptions.__annotations__.keys() | options.Reading.__annotations__.keys()
    assert not common & command.Options.__annotations__.keys()
    with pytest.raises(SystemExit):
        command.main(["--help"])
    said = capsys.readouterr().out
    for name in common:
        dashed = {"missing_masks": "data.missing-masks", "mask_source": "data.mask-source"}.get(name, name)
        assert f"--{dashed.replace('_', '-')}" in said
    assert command.main(["one", "--data", "two"]) == 2
    assert "two scenes: one and two" in capsys.readouterr().err
