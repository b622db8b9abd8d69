"""Readies a bare machine: wheels, this checkout's entry points, and the CUDA code of gsplat and nerfacc."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from build_cuda import PACKAGES, built_name

CHECKOUT = Path(__file__).resolve().parents[2]
BUILDER = Path(__file__).with_name("build_cuda.py")


def install_wheels(wheels: Path, site: Path) -> str:
    """Unpacks all wheels of a folder; returns what pip had to say against it, or nothing."""
    found = sorted(wheels.glob("*.whl"))
    if not found:
        return f"no wheels in {wheels}"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile"]
    command += ["--no-cache-dir", "--upgrade", "--target", str(site), *map(str, found)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return "" if done.returncode == 0 else done.stderr.strip()[-500:]


def register_checkout(site: Path) -> bool:
    """Writes the entry points that `pip install` of the checkout would; False where it is installed already."""
    if importlib.metadata.entry_points(group="visdom.methods"):
        return False
    import tomllib

    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    folder = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    folder.mkdir(parents=True, exist_ok=True)
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (folder / "METADATA").write_text(head)
    groups = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
    lines = []
    for group, entries in groups.items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()), ""]
    (folder / "entry_points.txt").write_text("\n".join(lines))
    return True


def environment(site: Path) -> dict[str, str]:
    """Environment variables of every part's process."""
    paths = [str(site), str(CHECKOUT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONUNBUFFERED": "1"}


class Compilation:
    """gsplat's and nerfacc's CUDA code: taken from a cache folder, or compiled there in the background."""

    def __init__(self, cache: Path, device: str, env: dict[str, str]):
        self.cache, self.notes = cache, {}
        self._running: dict[str, tuple[subprocess.Popen, float]] = {}
        self._env, self._began = env, time.monotonic()
        for package in PACKAGES:
            if self._put(package):
                self.notes[package] = "compiled before"
            elif device != "cuda":
                self.notes[package] = "not compiled: a dry run"
            else:
                self._start(package)

    def _put(self, package: str) -> bool:
        """Installs the cached file, if there is one and torch here loads it."""
        if not (self.cache / built_name(package)).is_file():
            return False
        code = (
            f"import sys; sys.path.insert(0, {str(BUILDER.parent)!r}); from pathlib import Path; import torch; "
            f"from build_cuda import install; install({package!r}, Path({str(self.cache)!r})); "
            f"from {package} import csrc"
        )
        done = subprocess.run([sys.executable, "-c", code], env=self._env, capture_output=True, text=True)
        if done.returncode:
            self.notes[package] = "the cached file does not load: " + done.stderr.strip()[-300:]
        return done.returncode == 0

    def _start(self, package: str) -> None:
        self.cache.mkdir(parents=True, exist_ok=True)
        log = (self.cache / f"{package}.log").open("w")
        command = ["nice", "-n", "5", sys.executable, str(BUILDER), package, str(self.cache)]
        process = subprocess.Popen(command, env=self._env, stdout=log, stderr=log, start_new_session=True)
        self._running[package] = process, time.monotonic()

    def poll(self) -> None:
        """Takes note of what has ended."""
        for package, (process, began) in list(self._running.items()):
            if process.poll() is None:
                continue
            del self._running[package]
            if process.returncode == 0 and self._put(package):
                self.notes[package] = f"compiled here in {time.monotonic() - began:.0f} s"
            else:
                lines = (self.cache / f"{package}.log").read_text(errors="replace").splitlines()
                told = [line for line in lines if "error" in line.lower()][:3] or lines[-3:]
                self.notes[package] = "does not compile here: " + " / ".join(told)[-600:]

    def ready(self, package: str) -> bool | None:
        """True or False once it is known, None while it is being compiled."""
        self.poll()
        if package in self._running:
            return None
        return self.notes.get(package, "").startswith("compiled")

    def stop(self) -> None:
        """Ends what still runs."""
        for process, _ in self._running.values():
            os.killpg(process.pid, 15)


def describe(device: str, env: dict[str, str]) -> dict[str, str]:
    """The card and the versions that numbers depend on."""
    code = (
        "import json, platform, torch, numba, numpy\n"
        "d = {'python': platform.python_version(), 'torch': torch.__version__, 'numba': numba.__version__,"
        " 'numpy': numpy.__version__}\n"
        f"if {device == 'cuda'}:\n"
        "    p = torch.cuda.get_device_properties(0)\n"
        "    d['card'] = f'{p.name}, {p.multi_processor_count} multiprocessors,"
        " {p.total_memory / 2**30:.0f} GiB'\n"
        "try:\n    import triton; d['triton'] = triton.__version__\nexcept ImportError: pass\n"
        "print(json.dumps(d))"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120
        )
        found = json.loads(done.stdout.strip().splitlines()[-1])
    except (subprocess.TimeoutExpired, IndexError, ValueError):
        return {"error": "torch does not start: " + done.stderr.strip()[-400:]}
    return found | {"processors": str(os.cpu_count())}
