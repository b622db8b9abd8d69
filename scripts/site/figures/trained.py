"""Runs that figures show: trained here where they are not there yet, on one thread, budget quick, seed 0."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path


def read_options(about: str | None, pictures: Path | None = None) -> argparse.Namespace:
    """`runs`, the folder of the runs, and `out`, that of the pictures where a script can write them elsewhere."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/figures"))
    if pictures is not None:
        parser.add_argument("--out", type=Path, default=pictures)
    return parser.parse_args()


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
