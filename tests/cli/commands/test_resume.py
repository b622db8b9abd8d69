"""The promise on the real method: killed at any moment, a run resumes to the same result, bit for bit."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from visdom_plugin.cli.commands import check
from visdom_plugin.training.runs import checkpoints

ROOT = Path(__file__).resolve().parents[3]
# Every kind of event of the long schedule happens within these steps.
SETTINGS = {
    "steps": 60,
    "initial-points": 600,
    "sh-every": 15,
    "densify-from": 5,
    "densify-every": 10,
    "densify-until": 50,
    "prune-large-from": 20,
    "floater-every": 15,
    "opacity-reset-every": 25,
    "hull.resolution": 64,
}
WORDS = ["method:3dgs-go+vd", "--downscale=2", "--device=cpu", "--quiet", "--checkpoint-seconds=0.02"]
WORDS += [f"--method.{name}={value}" for name, value in SETTINGS.items()]


def _start(run: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "visdom_plugin.cli.commands.train", *WORDS, f"--out={run}"]
    return subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "2"}, stderr=subprocess.PIPE, text=True
    )


def _finish(run: Path) -> None:
    child = _start(run)
    _, err = child.communicate()
    assert child.returncode == 0, err


@pytest.mark.slow
def test_a_killed_run_of_3dgs_go_vd_ends_bit_for_bit_where_it_would_have(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    _finish(whole)
    child = _start(cut)
    draw = random.Random(time.time_ns())
    reached = draw.randrange(1, 45)
    while child.poll() is None and max(checkpoints.list_steps(cut / "checkpoints"), default=0) < reached:
        time.sleep(0.002)
    time.sleep(draw.uniform(0, 0.03))
    child.kill()
    assert child.wait() == -signal.SIGKILL
    child.stderr.close()
    steps = checkpoints.list_steps(cut / "checkpoints")
    assert steps and steps[-1] <= 60
    _finish(cut)
    states = [checkpoints.load(run / "checkpoints", 60).tensors for run in (whole, cut)]
    assert states[0].keys() == states[1].keys()
    different = [k for k in states[0] if not torch.equal(states[0][k], states[1][k])]
    assert not different
    records = [json.loads((run / "run.json").read_text()) for run in (whole, cut)]
    assert records[0]["metrics"] == records[1]["metrics"]
    assert (whole / "export/point_cloud.ply").read_bytes() == (cut / "export/point_cloud.ply").read_bytes()


def test_ctrl_c_says_which_command_to_repeat(capsys, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt  # as Python's own handler does, which a background job does not have

    monkeypatch.setattr(check, "load_torch", interrupt)
    assert check.main(["builtin:duck", "--views", "5"]) == 130
    assert capsys.readouterr().err == "interrupted; repeat with: visdom-check builtin:duck --views 5\n"
