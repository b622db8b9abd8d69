"""What this environment offers, line by line, for `visdom-methods --doctor`."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, distributions, version
from importlib.util import find_spec

from visdom_plugin.registry import Registry


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
    for name, origin in known.origins.items():
        lines.append(f"method {name}: from {origin}, {known.presets[name].target}")
    lines += [f"warning: {origin} was skipped: {reason}" for origin, reason in known.broken.items()]
    return lines


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
