"""Folders of the networks: what is missing is named before any work, with where to get it. Needs no network."""

import json
from dataclasses import replace
from importlib.util import find_spec

import pytest

from method_configs.gaussian_object import SPEC
from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.methods.repair import weights
from visdom_plugin.methods.repair.weights import VARIABLE, WeightsConfig, find_files

FILES = {
    "stable-diffusion-v1-5/unet": ("config.json", "diffusion_pytorch_model.safetensors"),
    "stable-diffusion-v1-5/vae": ("config.json", "diffusion_pytorch_model.safetensors"),
    "stable-diffusion-v1-5/text_encoder": ("config.json", "model.safetensors"),
    "stable-diffusion-v1-5/tokenizer": ("vocab.json", "merges.txt"),
    "stable-diffusion-v1-5/scheduler": ("scheduler_config.json",),
    "control_v11f1e_sd15_tile": ("config.json", "diffusion_pytorch_model.safetensors"),
}


@pytest.fixture
def folder(tmp_path):
    """The layout, of files that hold nothing but the number of halvings."""
    for part, names in FILES.items():
        (tmp_path / part).mkdir(parents=True)
        for name in names:
            (tmp_path / part / name).write_text(json.dumps({"block_out_channels": [1, 1, 1, 1]}))
    return tmp_path


@pytest.mark.parametrize("part", FILES)
def test_a_missing_folder_or_file_is_named_with_its_source(folder, part):
    source = "stable-diffusion-v1-5/" if part.startswith("stable") else "lllyasviel/control_v11f1e_sd15_tile"
    for name in FILES[part]:
        path = folder / part / name
        content = path.read_text()
        path.unlink()
        with pytest.raises(PluginError) as caught:
            find_files(WeightsConfig(folder=folder))
        assert caught.value.where == path and source in caught.value.todo
        path.write_text(content)
    (folder / part).rename(folder / "elsewhere")
    with pytest.raises(PluginError) as caught:
        find_files(WeightsConfig(folder=folder))
    assert caught.value.where == folder / part and "hf download" in caught.value.todo


def test_folders_may_be_named_one_by_one_or_by_the_variable(folder, monkeypatch, tmp_path):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(PluginError, match="no folder is named") as caught:
        find_files(WeightsConfig(sd=folder / "stable-diffusion-v1-5"))
    assert VARIABLE in caught.value.todo and "control_v11f1e_sd15_tile" in str(caught.value)
    assert "stable-diffusion-v1-5/stable" not in str(caught.value)
    one_by_one = WeightsConfig(
        sd=folder / "stable-diffusion-v1-5", controlnet=folder / "control_v11f1e_sd15_tile"
    )
    monkeypatch.setenv(VARIABLE, str(folder))
    named = find_files(WeightsConfig())
    assert find_files(one_by_one).parts == named.parts and named.variants["unet"] is None
    with pytest.raises(PluginError, match="stable-diffusion-v1-5"):
        find_files(WeightsConfig(folder=tmp_path / "nothing"))


def test_half_precision_and_pickled_weights_are_taken_where_they_are_all_there_is(folder):
    unet = folder / "stable-diffusion-v1-5" / "unet" / "diffusion_pytorch_model.safetensors"
    unet.rename(unet.with_name("diffusion_pytorch_model.fp16.safetensors"))
    tile = folder / "control_v11f1e_sd15_tile" / "diffusion_pytorch_model.safetensors"
    tile.rename(tile.with_suffix(".bin"))
    variants = find_files(WeightsConfig(folder=folder)).variants
    assert variants == {"unet": "fp16", "vae": None, "text_encoder": None, "controlnet": None}


def test_a_missing_package_is_named(folder, monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda name: None if name == "peft" else find_spec("json"))
    with pytest.raises(PluginError, match="needs peft, not installed") as caught:
        weights.check(WeightsConfig(folder=folder), 512)
    assert "visdom-plugin[diffusion]" in caught.value.todo


def test_pictures_that_the_networks_cannot_halve_are_refused(folder, monkeypatch):
    monkeypatch.setattr(weights, "find_spec", lambda name: find_spec("json"))
    config = replace(SPEC.full, weights=WeightsConfig(folder=folder))
    config.check_requirements()
    with pytest.raises(ConfigError, match="cannot be halved 6 times") as caught:
        replace(config, image_size=480).check_requirements()
    assert "multiple of 64" in caught.value.todo


def test_the_digest_tells_other_weights_and_settings(folder):
    before = find_files(WeightsConfig(folder=folder)).digest()
    assert find_files(WeightsConfig(folder=folder)).digest() == before
    (folder / "stable-diffusion-v1-5" / "scheduler" / "scheduler_config.json").write_text("{}")
    assert find_files(WeightsConfig(folder=folder)).digest() != before


@pytest.mark.parametrize(
    ("part", "changes", "option"),
    [
        ("loo", {"view_returns": 10_000}, "--method.loo.view-returns"),
        ("lora", {"noise_scale": (0.8, 0.6)}, "--method.lora.noise-scale"),
        ("lora", {"rank": 0}, "--method.lora.rank"),
        ("repair", {"until": 4_001}, "--method.repair.until"),
        ("repair", {"strength": (0.0, 1.0)}, "--method.repair.strength"),
        ("repair", {"share": (1.5, 0.5)}, "--method.repair.share"),
    ],
)
def test_settings_out_of_range_name_their_option(part, changes, option):
    with pytest.raises(ConfigError) as caught:
        replace(getattr(SPEC.full, part), **changes)
    assert option in caught.value.where


def test_bare_and_vd_differ_by_the_hook_alone():
    presets = SPEC.presets()
    bare, vd = presets["gaussianobject"].full, presets["gaussianobject+vd"].full
    changed = {name for name in bare.__dataclass_fields__ if getattr(bare, name) != getattr(vd, name)}
    assert changed == {"hull", "vd", "mask_weight", "floater_every"}
