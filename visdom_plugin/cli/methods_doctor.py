"""Lists what this environment offers, line by line, for `visdom-methods --doctor`."""

from __future__ import annotations

import os
import platform
import shutil
from importlib.metadata import PackageNotFoundError, distributions, version
from importlib.util import find_spec

from visdom_plugin.errors import PluginError
from visdom_plugin.registry import Registry, Skipped, tell


def examine(known: Registry) -> list[str]:
    """Lines "name: what was found"; those that begin with "warning" want attention."""
    lines = [f"python: {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"]
    lines.append(f"visdom-plugin: {_version('visdom-plugin')}")
    lines += _torch()
    lines.append(f"numba: {_version('numba')}")
    for name, why in (
        ("gsplat", "Gaussians on CUDA: pip install 'visdom-plugin[cuda]'"),
        ("lpips", "LPIPS metric: pip install 'visdom-plugin[lpips]'"),
        ("av", "H.264 video: pip install 'visdom-plugin[video]'"),
        ("nerfstudio", "ns-train with the visible domain: pip install 'visdom-plugin[nerfstudio]'"),
        ("diffusers", "method:gaussianobject: pip install 'visdom-plugin[diffusion]'"),
        ("nerfacc", "its rays and occupancy grids: pip install nerfacc"),
        ("submitit", "jobs on a Slurm cluster: pip install submitit"),
    ):
        found = _version(name)
        lines.append(f"{name}: {found}" if found != "not found" else f"{name}: not found ({why})")
    opencv = opencv_distributions()
    lines.append("opencv: " + (", ".join(f"{n} {v}" for n, v in opencv) or "not found"))
    if len(opencv) > 1:
        lines.append(
            "warning: several OpenCV distributions share the folder cv2/ and overwrite each other; "
            f"keep one: pip uninstall {' '.join(n for n, _ in opencv)} "
            "&& pip install opencv-contrib-python-headless"
        )
    lines.append(_slurm())
    for name, origin in known.origins.items():
        release = _version(origin)
        release = f" {release}" if release != "not found" else ""
        lines.append(f"method {name}: from {origin}{release}, {known.presets[name].target}")
    lines += _unusable(known)
    for origin, (seconds, heavy) in known.slow.items():
        lines.append(
            f"warning: listing {origin}'s methods imports {', '.join(heavy)} ({seconds:.1f} s per --help); move "
            "its MethodSpec to a module that imports nothing heavy"
        )
    for skipped in known.skipped:
        lines += _story(skipped)
    return lines


def _slurm() -> str:
    found = {name: shutil.which(name) for name in ("sbatch", "sinfo")}
    if not any(found.values()):
        return "slurm: not found (no sbatch, no sinfo)"
    return "slurm: " + ", ".join(f"{name} {path or 'not found'}" for name, path in found.items())


def _unusable(known: Registry) -> list[str]:
    """Methods whose class cannot be imported, each class once."""
    lines, seen = [], set()
    for name, preset in known.presets.items():
        if preset.target in seen:
            continue
        seen.add(preset.target)
        try:
            preset.load()
        except PluginError as error:
            lines.append(f"warning: {error}")
            lines += _indent(tell(error.__cause__)) if error.__cause__ is not None else []
            lines.append(f"  offered by: {known.origins[name]}")
    return lines


def _story(skipped: Skipped) -> list[str]:
    release = f" {skipped.version}" if skipped.version else ""
    return [
        f"warning: {skipped.origin}{release} ({skipped.value}) was skipped: {skipped.reason}",
        *_indent(skipped.story),
        f"  what to do: {skipped.todo}",
    ]


def _indent(text: str) -> list[str]:
    return [f"  | {line}" for line in text.splitlines()]


def opencv_distributions() -> list[tuple[str, str]]:
    """Installed distributions that own the folder cv2/: (name, version)."""
    names = {d.metadata["Name"]: d.version for d in distributions()}
    return sorted((n, v) for n, v in names.items() if n and n.lower().startswith("opencv-"))


def _torch() -> list[str]:
    if find_spec("torch") is None:
        return ["torch: not found"]
    import torch

    lines = [f"torch: {torch.__version__}, {torch.get_num_threads()} threads"]
    if torch.cuda.is_available():
        lines.append(f"cuda: {torch.version.cuda}, {torch.cuda.get_device_name()}")
    else:
        lines.append("cuda: " + ("no device found" if torch.version.cuda else "this torch is a CPU build"))
    return lines


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not found"
