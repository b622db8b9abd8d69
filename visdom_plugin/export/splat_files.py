"""Files of Gaussians by their suffix: .ply, .spz and .splat written and read, .sog, .html by splat-transform."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.atomic_files import appearing, write_bytes
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.export.splat_page import write_page
from visdom_plugin.export.splat_transform import splat_transform
from visdom_plugin.export.spz import read_spz, write_spz
from visdom_plugin.geometry.harmonics import C0
from visdom_plugin.geometry.local_frame import is_near
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.ply import read_ply, read_ply_near, write_gaussians
from visdom_plugin.splat.spherical_harmonics import sh_from_rgb

WRITTEN = ("ply", "spz", "splat", "sog", "html")
READ = ("ply", "spz", "splat", "sog")
_SPLAT = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""The records of a .splat file: scales and colours after activation, no harmonics, w x y z times 128 plus 128."""


def write_splats(
    path: Path,
    gaussians: Gaussians,
    origin: Tensor | None = None,
    *,
    title: str | None = None,
    eye: Tensor | None = None,
) -> None:
    """Writes Gaussians as the suffix of `path` says; the file appears whole or not at all.

    Args:
        origin: (3,) float64 of their frame in the frame the file shall have; None for the same frame.
        title, eye: of a page, see `write_page`.

    Raises:
        ConfigError: the format needs splat-transform, which is not there or fails; or it cannot hold such a frame,
            see `refuse_far`.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind == "ply":
        write_gaussians(path, gaussians, origin)
        return
    refuse_far(path, gaussians, origin)
    if kind == "spz":
        write_spz(path, gaussians, origin)
    elif kind == "splat":
        write_bytes(path, _splat_bytes(gaussians, origin))
    elif kind == "html":
        write_page(path, gaussians, title=title, eye=eye)
    else:
        with tempfile.TemporaryDirectory() as folder, appearing(path) as part:
            plain = Path(folder) / f"{path.stem}.ply"
            write_gaussians(plain, gaussians if origin is None else _shift(gaussians, origin))
            splat_transform(plain, part, asked=path)


def refuse_far(path: Path, gaussians: Gaussians, origin: Tensor | None) -> None:
    """Refuses Gaussians that are too far from their frame's origin for numbers of 32 bits.

    Raises:
        ConfigError: they are, see `local_frame.is_near`.
    """
    means = gaussians.means.detach().cpu().double() + (0 if origin is None else origin)
    spread = float(np.ptp(means.numpy(), axis=0).max(initial=0)) if len(means) else 0.0
    if len(means) > 1 and not is_near(means, spread):
        raise ConfigError(
            f"positions reach {float(means.abs().max()):.7g} from the origin over a scene of {spread:.3g}, "
            f"and {path.suffix} holds them in 32 bits or less, which moves them",
            where=path,
            cause="a capture in map coordinates, far from the origin",
            todo="move it to the middle with --upright (of a file, with --data DIR, its scene), or write a .ply, "
            "which holds them in 64 bits",
        )


def read_splats(path: Path, origin: Tensor | None = None) -> Gaussians:
    """Reads a file of Gaussians, float32 on the CPU.

    Args:
        origin: (3,) float64; with it the means are relative to it.

    Raises:
        SceneError: for a file that is missing, damaged or of another kind.
        ConfigError: for a .sog file where splat-transform is not there.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind == "ply":
        return read_ply(path, origin)
    if kind not in READ:
        raise SceneError(
            f"files of kind {path.suffix or '(no suffix)'} are not read",
            where=path,
            todo=f"give one of {', '.join('.' + k for k in READ)}",
        )
    if not path.is_file():
        raise SceneError("there is no such file", where=path)
    if kind == "sog":
        with tempfile.TemporaryDirectory() as folder:
            splat_transform(path, Path(folder) / "plain.ply", asked=Path(folder) / "plain.ply")
            return read_ply(Path(folder) / "plain.ply", origin)
    found = read_spz(path) if kind == "spz" else _parse_splat(path)
    return found if origin is None else _shift(found, -origin)


def read_near(path: Path) -> tuple[Gaussians, Tensor]:
    """What `read_splats` reads, relative to an origin (3,) float64 near them; zero where the file's is near."""
    if path.suffix.lower() == ".ply":
        return read_ply_near(path)
    return read_splats(path), torch.zeros(3, dtype=torch.float64)


def describe(path: Path) -> dict[str, Any]:
    """What a file of Gaussians holds: numbers, ranges, comments.

    Raises:
        SceneError, ConfigError: as `read_splats`.
    """
    found, origin = read_near(path)
    n = len(found)
    about: dict[str, Any] = {"file": str(path), "bytes": path.stat().st_size, "gaussians": n}
    about["degree"] = found.degree
    if path.suffix.lower() == ".ply":
        head = path.read_bytes()[: 1 << 16].partition(b"end_header")[0].decode("ascii", "replace")
        about["comments"] = [
            x.removeprefix("comment ") for x in head.splitlines() if x.startswith("comment ")
        ]
    if n:
        means, scales = found.means.double() + origin, found.log_scales.double().exp()
        opacity = found.opacity_logits.double().sigmoid()
        lower, upper = (torch.quantile(means[:: max(1, n // 100_000)], q, 0) for q in (0.01, 0.99))
        about |= {
            "bounds": [means.amin(0).tolist(), means.amax(0).tolist()],
            "bounds_98_percent": [lower.tolist(), upper.tolist()],
            "scale_median": float(scales.median()),
            "scale_largest": float(scales.max()),
            "opacity_mean": float(opacity.mean()),
            "nearly_transparent": float((opacity < 1 / 255).double().mean()),
            "not_finite": int(sum((~torch.isfinite(v)).any() for v in found.tensors().values())),
        }
    return about


def _shift(gaussians: Gaussians, by: Tensor) -> Gaussians:
    values = gaussians.tensors()
    return Gaussians(**values | {"means": (gaussians.means.detach().cpu().double() + by).float()})


def _splat_bytes(gaussians: Gaussians, origin: Tensor | None) -> bytes:
    g = gaussians.detach().to("cpu", torch.float64)
    # Viewers of this format draw as they come: the largest and most opaque first.
    order = torch.argsort(g.log_scales.sum(1).exp() * g.opacity_logits.sigmoid(), descending=True)
    table = np.empty(len(g), _SPLAT)
    table["xyz"] = (g.means if origin is None else g.means + origin)[order]
    table["scale"] = g.log_scales.exp()[order]
    rgb = 0.5 + C0 * g.sh[:, 0]
    rgba = torch.cat([rgb, g.opacity_logits.sigmoid()[:, None]], 1)
    table["rgba"] = (rgba[order] * 255).round().clamp(0, 255)
    turn = torch.nn.functional.normalize(g.quaternions, dim=-1)
    table["rotation"] = (turn[order] * 128 + 128).round().clamp(0, 255)
    return table.tobytes()


def _parse_splat(path: Path) -> Gaussians:
    data = path.read_bytes()
    if not data or len(data) % _SPLAT.itemsize:
        raise SceneError(
            f"the file has {len(data)} bytes, which is no multiple of {_SPLAT.itemsize}",
            where=path,
            cause="a file that is cut off, or of another kind",
        )
    table = np.frombuffer(data, _SPLAT)
    rgba = torch.from_numpy(table["rgba"].astype(np.float32)) / 255
    return Gaussians(
        torch.from_numpy(table["xyz"].copy()),
        torch.from_numpy(np.log(np.maximum(table["scale"], 1e-12))),
        (torch.from_numpy(table["rotation"].astype(np.float32)) - 128) / 128,
        rgba[:, 3].clamp(1e-4, 1 - 1e-4).logit(),
        sh_from_rgb(rgba[:, None, :3]),
    )
