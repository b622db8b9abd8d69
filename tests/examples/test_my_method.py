"""The example package, as a stranger's: installed by pip, listed, trained."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene

EXAMPLE = Path(__file__).parents[2] / "examples" / "my_method"


def test_the_example_is_short():
    files = [p for p in EXAMPLE.rglob("*") if p.suffix in (".py", ".toml") and "build" not in p.parts]
    assert len(files) == 3 and sum(len(p.read_text().splitlines()) for p in files) <= 80


def test_rays_that_look_away_show_the_background(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLE)
    from my_method import Config
    from my_method.field import Field

    views = make_scene(SyntheticConfig(size=16, train_views=3, test_views=0)).train
    field = Field(Config(samples=4, resolution=4))
    field.setup(views, [], hull=None, device=torch.device("cpu"), seed=0)
    origins, towards = views.cameras.centres, views.cameras.forward
    red = torch.tensor([1.0, 0, 0])
    for sign, sees in ((1, True), (-1, False)):
        rgb, alpha, _ = field.trace(origins, sign * towards, red, [])
        assert torch.isfinite(rgb).all() and (alpha > 0).all() == sees
        assert torch.equal(rgb, red.expand(3, 3)) != sees


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """run(module, *words) of a Python where the example is installed, and nothing else new."""
    for needed in ("pip", "setuptools"):
        if importlib.util.find_spec(needed) is None:
            pytest.skip(f"{needed} is not installed here, so no package can be")
    folder = tmp_path_factory.mktemp("example")
    # pip builds where the sources are.
    sources = shutil.copytree(
        EXAMPLE, folder / "sources", ignore=shutil.ignore_patterns("build", "*.egg-info")
    )
    # A run in the folder of the example leaves this behind.
    (sources / "runs").mkdir()
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    done = subprocess.run([*pip, "--target", folder / "site", sources], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    def call(module: str, *words: str) -> subprocess.CompletedProcess:
        environment = os.environ | {"PYTHONPATH": str(folder / "site")}
        environment.pop("VISDOM_METHODS", None)
        command = [sys.executable, "-m", module, *words]
        return subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200
        )

    return call


def test_all_three_variants_are_listed_with_their_settings(run):
    listed = run("visdom_plugin.cli.commands.methods")
    assert listed.returncode == 0 and not listed.stderr
    for name in ("method:my-method ", "method:my-method+mask ", "method:my-method+vd "):
        assert name in listed.stdout
    described = run("visdom_plugin.cli.commands.train", "method:my-method+vd", "--help")
    assert described.returncode == 0, described.stderr
    # Its own, those added, and what those are.
    for words in ("--method.rays", "--method.mask-weight", "--method.hull.k", "Weight of the binary cross"):
        assert words in described.stdout, words


def test_it_trains_in_the_visible_domain(run, tmp_path):
    small = ("--method.steps", "12", "--method.rays", "128", "--method.hull.resolution", "48")
    words = ("--downscale", "4", *small, "--device", "cpu", "--out", str(tmp_path / "run"))
    done = run("visdom_plugin.cli.commands.train", "method:my-method+vd", *words)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["status"] == "finished" and record["method"] == "my-method+vd"
    assert record["config"]["vd"]["enabled"] and record["config"]["mask_weight"] == 0.1
    assert record["config"]["hull"]["resolution"] == 48 and record["config"]["rays"] == 128
    assert record["metrics"]["test"]["psnr"] > 3
    assert (tmp_path / "run" / "hull" / "hull.npz").is_file() and (tmp_path / "run" / "checkpoints").is_dir()
    again = run("visdom_plugin.cli.commands.evaluate", str(tmp_path / "run"))
    assert again.returncode == 0, again.stderr
    measured = json.loads((tmp_path / "run" / "run.json").read_text())["metrics"]["test"]
    assert measured == record["metrics"]["test"]
