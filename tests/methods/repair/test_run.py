"""A whole run on disk: interrupted in every stage, finished, and shown without the networks."""

import shutil
from dataclasses import replace

import pytest
import torch

from visdom_plugin import registry
from visdom_plugin.errors import PluginError
from visdom_plugin.methods.repair.gaussian_object import GaussianObject
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import Interrupted, restore, train
from visdom_plugin.training.runs import checkpoints

NAME = "gaussianobject+vd"


def go(config, scene, folder, seconds=1e9):
    return train(
        NAME,
        config,
        scene,
        data_manager=DataManager,
        run_dir=folder,
        quiet=True,
        checkpoint_seconds=seconds,
    )


def test_a_run_interrupted_in_every_stage_ends_as_one_that_was_not(small, scene, tmp_path, monkeypatch):
    whole = go(small, scene, tmp_path / "whole")
    assert whole["status"] == "finished" and whole["model"]["stage"] == 4
    starts = {"leave-one-out begins": [12], "fine-tuning begins": [84], "repair begins": [90]}
    assert whole["events"] == {"last Gaussians added": [6]} | starts
    real = GaussianObject.train_step
    for stop in (5, 40, 87, 95):

        def interrupt(self, batch, step, stop=stop):
            if step == stop:
                raise KeyboardInterrupt
            return real(self, batch, step)

        monkeypatch.setattr(GaussianObject, "train_step", interrupt)
        with pytest.raises(Interrupted):
            go(small, scene, tmp_path / "cut", seconds=0)
    monkeypatch.setattr(GaussianObject, "train_step", real)
    cut = go(small, scene, tmp_path / "cut")
    assert cut["resumed_from"] == 95 and cut["metrics"] == whole["metrics"]
    assert cut["events"] == whole["events"]
    one, other = (checkpoints.load_newest(tmp_path / name / "checkpoints") for name in ("whole", "cut"))
    assert one.step == other.step == 100 and one.tensors.keys() == other.tensors.keys()
    assert all(torch.equal(value, other.tensors[name]) for name, value in one.tensors.items())


def test_a_run_without_weights_is_refused_before_anything_is_made(small, scene, tmp_path):
    folder = tmp_path / "weights"
    shutil.copytree(small.weights.folder, folder)
    (folder / "stable-diffusion-v1-5" / "vae" / "config.json").unlink()
    lost = replace(small, weights=replace(small.weights, folder=folder))
    with pytest.raises(PluginError, match=r"no file config\.json of stable-diffusion-v1-5"):
        go(lost, scene, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_finished_run_is_restored_where_the_weights_are_gone(small, scene, tmp_path):
    folder = tmp_path / "weights"
    shutil.copytree(small.weights.folder, folder)
    config = replace(small, weights=replace(small.weights, folder=folder))
    go(config, scene, tmp_path / "run")
    shutil.rmtree(folder)
    preset = registry.find(NAME)
    device = torch.device("cpu")
    method, _, step = restore(preset, config, scene.train, tmp_path / "run", device=device, seed=0)
    assert step == method.total_steps == 100
    assert method.render(scene.train.cameras[0], torch.ones(3)).alpha.max() > 0
