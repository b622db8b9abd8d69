"""Nerfstudio's commands, and the methods and data parser that they find."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: see scripts/nerfstudio_env.sh")

import yaml

from datamodules import load
from visdom_plugin.integrations.nerfstudio import methods
from visdom_plugin.integrations.nerfstudio.dataparser import VisdomDataParserConfig
from visdom_plugin.integrations.nerfstudio.frame import similarity_of


def test_the_page_of_the_docs_trains_measures_and_resumes(tmp_path, monkeypatch):
    """`ns-train`, `ns-eval` and `--load-dir`, as typed, on the built-in scene."""
    from nerfstudio.scripts import eval as evaluating
    from nerfstudio.scripts import train as training

    page = Path(__file__).parents[3] / "docs/nerfstudio.md"
    (block,) = re.findall(r"```bash\n(.*?)```", page.read_text(), re.S)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = shlex.split(block.replace("\\\n", " "))

    def call(entrypoint, *words):
        monkeypatch.setattr(sys, "argv", list(words))
        entrypoint()

    run = tmp_path / "out/tiny/nerfacto-vd/now"
    call(training.entrypoint, *words)
    assert [p.name for p in run.glob("nerfstudio_models/*")] == ["step-000000002.ckpt"]
    transform = json.loads((run / "dataparser_transforms.json").read_text())
    frame = similarity_of(load(None, views=4, downscale=8).train.cameras)
    assert np.allclose(transform["transform"], frame.transform, atol=1e-6)
    assert transform["scale"] == frame.scale
    call(
        evaluating.entrypoint,
        "ns-eval",
        "--load-config",
        str(run / "config.yml"),
        "--output-path",
        "eval.json",
    )
    results = json.loads(Path("eval.json").read_text())["results"]
    assert 3 < results["psnr"] < 40 and 0 < results["ssim"] < 1
    at = words.index("visdom")
    again = ["--load-dir", str(run / "nerfstudio_models"), "--timestamp", "later"]
    call(training.entrypoint, *words[:at], *again, *words[at:])
    later = run.parent / "later/nerfstudio_models"
    assert [p.name for p in later.iterdir()] == ["step-000000005.ckpt"]
    counts = []
    for checkpoint in (run / "nerfstudio_models/step-000000002.ckpt", later / "step-000000005.ckpt"):
        adam = torch.load(checkpoint, weights_only=False)["optimizers"]["fields"]["state"]
        counts.append({int(state["step"]) for state in adam.values()})
    assert counts == [{3}, {6}]


def test_nerfstudio_finds_the_methods_and_the_data_parser():
    from nerfstudio.configs.dataparser_configs import all_dataparsers
    from nerfstudio.configs.method_configs import all_methods

    assert isinstance(all_dataparsers["visdom"], VisdomDataParserConfig)
    for name in ("nerfacto-vd", "instant-ngp-vd", "splatfacto-vd"):
        assert all_methods[name].method_name == name
        assert all_methods[name].pipeline.datamanager.dataparser.background == "alpha"
    declared = importlib.metadata.entry_points(group="nerfstudio.method_configs").names
    assert {"nerfacto-vd", "instant-ngp-vd", "splatfacto-vd"} <= set(declared)


def test_sizes_and_schedules_are_nerfstudios():
    """What is written down in `methods` is what nerfstudio trains its own methods with."""
    from nerfstudio.configs.method_configs import all_methods

    for name in ("nerfacto", "instant-ngp", "splatfacto"):
        theirs, ours = all_methods[name], all_methods[f"{name}-vd"]
        assert ours.optimizers == theirs.optimizers
        for field in ("max_num_iterations", "mixed_precision", "steps_per_save", "steps_per_eval_batch"):
            assert getattr(ours, field) == getattr(theirs, field)
        model, base = vars(ours.pipeline.model), vars(theirs.pipeline.model)
        changed = {k for k in base if k != "_target" and model[k] != base[k]}
        assert changed == ({"background_color", "camera_optimizer"} if name == "nerfacto" else set())


@pytest.mark.parametrize("specification", [methods.NERFACTO, methods.INSTANT_NGP, methods.SPLATFACTO])
def test_saved_settings_come_back(specification):
    """Nerfstudio keeps a run's settings as YAML of Python objects, and ns-eval starts from them."""
    config = specification.config
    assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config
