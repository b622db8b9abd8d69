"""The types that a user's type checker finds, from outside the checkout, in the public names."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import visdom_plugin

ROOT = Path(__file__).parents[2]
PACKAGES = ("visdom_plugin", "method_configs", "datamodules")


def check(script: Path, folder: Path) -> str:
    """mypy's output about `script`, the packages found where installed ones are."""
    pytest.importorskip("mypy")
    shutil.copy(script, folder)
    command = [sys.executable, "-m", "mypy", "--strict", "--ignore-missing-imports", script.name]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MYPY_CACHE_DIR": str(folder / "cache")}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_public_names_have_their_types_for_a_user(tmp_path):
    assert "Success" in check(Path(__file__).with_name("typed_use.py"), tmp_path)


def test_the_typed_script_uses_every_public_name_and_all_three_packages_say_that_they_are_typed():
    script = Path(__file__).with_name("typed_use.py").read_text(encoding="utf-8")
    names = set(visdom_plugin.__all__) - {"__version__"}
    for name in names:
        assert getattr(visdom_plugin, name).__name__ == name
    assert set(re.findall(r"^    (\w+),$", script, re.M)) == names
    for package in PACKAGES:
        assert (ROOT / package / "py.typed").is_file()
    assert "Typing :: Typed" in importlib.metadata.metadata("visdom-plugin").get_all("Classifier")
