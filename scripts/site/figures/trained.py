"""Runs that figures show: trained here where they are not there yet, on one thread, budget quick, seed 0."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path


def train(folder: Path, method: str, views: int = 4, scene: str = "watering-can") -> Path:
    """The finished run of a method on a built-in scene, in `folder`/SCENE/VIEWS/METHOD."""
    run = folder / scene / str(views) / method
    record = run / "run.json"
    if not record.is_file() or json.loads(record.read_text(encoding="utf-8"))["status"] != "finished":
        words = [f"method:{method}", "--data", f"builtin:{scene}", "--views", str(views)]
        command = [sys.executable, "-m", "visdom_plugin.cli.commands.train", *words]
        command += ["--budget", "quick", "--out", str(run)]
        subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    return run
