"""Run directories of earlier versions still open: `runs_of_0_1_0.json` holds what version 0.1.0 wrote."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from visdom_plugin import registry
from visdom_plugin.cli.commands import train
from visdom_plugin.training.runs.config_io import as_plain, differences, from_plain
from visdom_plugin.training.runs.run_directory import read_record

OLD = json.loads(Path(__file__).with_name("runs_of_0_1_0.json").read_text())


@pytest.mark.parametrize("name", OLD)
def test_the_settings_of_an_old_run_are_read_and_mean_the_same(name, tmp_path):
    (tmp_path / "run.json").write_text(json.dumps(OLD[name]))
    record = read_record(tmp_path)
    preset = registry.find(record["method"])
    config = from_plain(preset.full, record["config"], "run.json")
    if name.startswith("3dgs"):
        # How large a Gaussian may be was a number of pixels.
        assert config.prune_radius_px == 20
        config = replace(config, prune_radius=preset.quick.prune_radius, prune_radius_px=None)
    assert config == preset.quick
    # Written again, they are what they were: a run that was cut short goes on.
    lines = differences(record["config"], json.loads(json.dumps(as_plain(config))))
    assert [line for line in lines if "(absent) ->" not in line] == [
        "prune_radius_px: 20.0 -> None" for _ in lines if name.startswith("3dgs")
    ][:1]


@pytest.mark.parametrize("name", ["ingp+vd", "3dgs-go+vd"])
def test_the_same_command_takes_an_old_run_for_its_own(name, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text(json.dumps(OLD[name]))
    command = [f"method:{name}", "--seed", "0", "--out", str(tmp_path / "run"), "--device", "cpu"]
    if name == "3dgs-go+vd":
        assert train.main(command) == 2
        error = capsys.readouterr().err
        assert "config.prune_radius_px: 20.0 -> None" in error and "initial_shape" not in error
        command += ["--method.prune-radius-px", "20"]
    assert train.main(command) == 0
    assert not (tmp_path / "run" / "checkpoints").exists()
    assert train.main([*command[:1], "--seed", "1", *command[3:]]) == 2
    assert "another run" in capsys.readouterr().err
