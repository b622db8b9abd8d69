"""PlayCanvas' splat-transform, which runs on Node and writes what is not written here."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from visdom_plugin.errors import ConfigError

_PACKAGE = "@playcanvas/splat-transform@2"


def splat_transform(source: Path, target: Path, *, asked: Path) -> None:
    """Converts by PlayCanvas' splat-transform, which runs on Node.

    Args:
        asked: the file that the user wants, for the command in an error.

    Raises:
        ConfigError: Node is not there, or the program fails.
    """
    line = f"npx {_PACKAGE} -g cpu FILE.ply {asked.name}"
    if found := shutil.which("splat-transform"):
        words = [found]
    elif found := shutil.which("npx"):
        words = [found, "--yes", _PACKAGE]
    else:
        raise ConfigError(
            f"a {asked.suffix} file is made by splat-transform, which needs Node.js, and there is none",
            where=asked,
            todo=f"install Node.js 18 or later; or export a .ply and run, where there is one: {line}",
            topic="not-installed",
        )
    done = subprocess.run(
        [*words, "-q", "-w", "-g", "cpu", source, target],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode or not target.exists():
        said = (done.stderr or done.stdout).strip().splitlines()
        raise ConfigError(
            f"splat-transform failed: {said[-1] if said else f'status {done.returncode}'}",
            where=asked,
            cause="no network to fetch it with npx" if "npx" in words[0] else None,
            todo=f"npm install --global {_PACKAGE}, or export a .ply and run where it works: {line}",
        )
