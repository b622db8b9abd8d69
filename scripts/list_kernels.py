"""Writes the list of kernels that commands compile ahead, visdom_plugin/compute/ahead.json.

    python scripts/list_kernels.py [JOB ...]         # all jobs, or only those named, such as "train ingp"

Each job runs on the built-in scene in a process of its own, with few steps. To be run after a kernel got another
name or other arguments; tests/compute/test_ahead.py tells.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from visdom_plugin.compute.ahead import LIST, Kernel, training_job

METHODS = (
    *("3dgs-go+vd", "corgs-lite+vd", "fsgs-lite+vd", "splatfields-lite+vd", "visdom-gs"),
    *("ingp+vd", "vaxnerf+hull", "visdom-field", "zerorf-lite+vd", "zipnerf-lite+vd"),
)
"""One variant of each: others have the same kernels but for a few. GaussianObject needs weights from elsewhere."""
DRAWN = {"zipnerf-lite+vd": ["--method.density-bias", "-6"]}
"""Without which nothing is drawn after so few steps, which is an error."""


def jobs() -> dict[str, list[str]]:
    """Command lines by job."""
    commands = {"hull": ["hull", "--out", "hull.ply"], "check": ["check"]}
    for name in METHODS:
        few = ["--method.steps", "3", "--device", "cpu", "--out", "run", "--no-report"]
        commands[training_job(name)] = ["train", f"method:{name}", *few, *DRAWN.get(name, [])]
    return commands


def record(words: list[str]) -> None:
    """In a process of its own: runs a command, and writes the kernels it asked the cache for to stdout."""
    from importlib import import_module

    from visdom_plugin.compute import kernels

    asked: dict[str, None] = {}
    load = kernels._StampedCache.load_overload

    def note(self: Any, types: Any, context: Any) -> object:
        if kernels._state.depth == 0:
            asked[Kernel.of(self._dispatcher.py_func, types).text] = None
        return load(self, types, context)

    kernels._StampedCache.load_overload = note  # type: ignore[method-assign]
    status = import_module(f"visdom_plugin.cli.commands.{words[0]}").main(words[1:])
    print(json.dumps({"status": status, "kernels": list(asked)}))


def run(words: list[str], cache: str) -> list[str]:
    """The kernels of one command line."""
    with tempfile.TemporaryDirectory() as folder:
        out = subprocess.run(
            [sys.executable, str(Path(__file__).resolve()), "--record", *words],
            env=os.environ | {"NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"},
            cwd=folder,
            capture_output=True,
            text=True,
        )
    if out.returncode or (answer := json.loads(out.stdout.splitlines()[-1]))["status"]:
        raise SystemExit(f"{' '.join(words)} failed:\n{out.stderr}")
    return list(answer["kernels"])


def write(path: Path, lists: dict[str, list[str]]) -> None:
    """Kernels once each, jobs as their numbers; a kernel's line says what changed in it."""
    kernels = sorted({text for texts in lists.values() for text in texts})
    numbers = {text: i for i, text in enumerate(kernels)}
    rows = [f"  {json.dumps(text)}" for text in kernels]
    lines = [f"  {json.dumps(job)}: {json.dumps([numbers[t] for t in lists[job]])}" for job in sorted(lists)]
    path.write_text('{"kernels": [\n' + ",\n".join(rows) + '\n],\n"jobs": {\n' + ",\n".join(lines) + "\n}}\n")


def main(words: list[str]) -> None:
    if words[:1] == ["--record"]:
        return record(words[1:])
    old = json.loads(LIST.read_text()) if LIST.exists() and words else {"kernels": [], "jobs": {}}
    lists = {job: [old["kernels"][i] for i in numbers] for job, numbers in old["jobs"].items()}
    commands = jobs()
    with tempfile.TemporaryDirectory() as folder:
        for job in words or commands:
            lists[job] = run(commands[job], os.environ.get("NUMBA_CACHE_DIR", folder))
            print(f"{len(lists[job]):4d} kernels  {job}", flush=True)
            write(LIST, lists)
    return None


if __name__ == "__main__":
    main(sys.argv[1:])
