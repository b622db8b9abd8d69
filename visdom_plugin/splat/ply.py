"""Gaussians as the `point_cloud.ply` of 3DGS: binary little endian, before activation.

Properties: x y z, nx ny nz (zero), f_dc_0..2, f_rest_* (all of red, then green, then blue), opacity (logit),
scale_0..2 (logarithms), rot_0..3 (w x y z). All are float, but x y z far from their frame's origin are double.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.geometry.local_frame import is_near
from visdom_plugin.splat.gaussians import Gaussians

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4",
    "uint32": "<u4", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
COMMENTS = ("comment Exported by visdom-plugin", "comment SplatRenderMode: default")
"""Viewers read the second: the Gaussians were fitted without the anti-aliasing filter of mip-splatting."""
_REST_OF_DEGREE = (0, 9, 24, 45)
_MAX_HEADER_BYTES = 1 << 16


def write_gaussians(path: str | Path, gaussians: Gaussians, origin: Tensor | None = None) -> None:
    """Writes a 3DGS point cloud; the file appears complete or not at all.

    Args:
        path: file to write.
        gaussians: any device and dtype.
        origin: (3,) float64 of their frame, in the frame the file shall have; None for the same frame.
    """
    arrays = {k: v.detach().cpu().float().numpy() for k, v in gaussians.tensors().items()}
    n, sh = len(gaussians), arrays["sh"]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh.shape[1] - 1))
    columns = [np.zeros((n, 3)), sh[:, 0], rest, arrays["opacity_logits"][:, None]]
    columns += [arrays["log_scales"], arrays["quaternions"]]
    far = origin if origin is not None and bool(origin.any()) else None
    names, places = _names(rest.shape[1]), "float" if far is None else "double"
    table = np.empty(n, [("xyz", _TYPES[places], 3), ("rest", "<f4", len(names) - 3)])
    table["xyz"] = arrays["means"] if far is None else gaussians.means.detach().cpu().double() + far
    table["rest"] = np.concatenate(columns, 1)
    header = ["ply", "format binary_little_endian 1.0", *COMMENTS, f"element vertex {n}"]
    header += [f"property {places} {name}" for name in names[:3]]
    header += [f"property float {name}" for name in names[3:]] + ["end_header", ""]
    write_bytes(Path(path), "\n".join(header).encode("ascii") + table.tobytes())


def read_ply(path: str | Path, origin: Tensor | None = None) -> Gaussians:
    """Reads a 3DGS point cloud, float32 on the CPU.

    With `origin` (3,) float64 the means are relative to it: far from the file's own, float32 cannot hold them.
    Properties may come in any order and number type, and unknown ones are passed over; normals may be missing.

    Raises:
        SceneError: for a file that is missing, truncated, of another format, without the properties of 3DGS, or
            with places that are not finite.
    """
    return _read(Path(path), origin)[0]


def read_ply_near(path: str | Path) -> tuple[Gaussians, Tensor]:
    """What `read_ply` reads, relative to an origin (3,) float64 near them; zero where the file's own is near."""
    return _read(Path(path), "near")


def _read(path: Path, origin: Tensor | Literal["near"] | None) -> tuple[Gaussians, Tensor]:
    """Gaussians and the origin that their means are relative to."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"cannot read the point cloud: {error.strerror}", where=path) from error
    count, dtype, start = _parse_header(data, path)
    needed = start + count * dtype.itemsize
    if len(data) < needed:
        raise SceneError(
            f"the point cloud ends after {len(data)} of {needed} bytes",
            where=path,
            cause="an interrupted download or a full disk",
            todo="fetch or export the file again",
        )
    rows = np.frombuffer(data, dtype, count, start)
    held = dtype.names or ()
    n_rest = sum(name.startswith("f_rest_") for name in held)
    missing = [name for name in _names(n_rest) if name not in held and name not in ("nx", "ny", "nz")]
    if missing or n_rest not in _REST_OF_DEGREE:
        what = f"lacks {list_some(missing, 6)}" if missing else f"has {n_rest} f_rest properties"
        raise SceneError(
            f"the point cloud {what}",
            where=path,
            cause="a mesh or a plain point cloud, not one of Gaussians",
            todo="give the point_cloud.ply of a 3DGS export, with harmonics of degree 0 to 3",
        )

    def take(prefix: str, size: int) -> np.ndarray:
        names = [f"{prefix}{i}" for i in range(size)]
        values = np.empty((count, size), np.float32)
        for i, name in enumerate(names):
            values[:, i] = rows[name]
        return values

    places = np.stack([rows[name].astype(np.float64) for name in "xyz"], -1)
    if origin is None or isinstance(origin, str):
        spread = float(np.ptp(places, axis=0).max(initial=0)) if count else 0.0
        near = origin is None or not np.isfinite(spread) or is_near(places, spread)
        origin = torch.from_numpy(np.zeros(3) if near else np.median(places, axis=0).round())
    means = (places - origin.numpy()).astype(np.float32)
    rest = take("f_rest_", n_rest).reshape(count, 3, n_rest // 3).transpose(0, 2, 1)
    sh = np.concatenate([take("f_dc_", 3)[:, None], rest], 1)
    opacity = rows["opacity"].astype(np.float32)
    lost = int((~np.isfinite(means)).any(1).sum())
    if lost:
        raise SceneError(
            f"{lost} of the {count} Gaussians have no finite place",
            where=path,
            cause="a training that diverged, or a damaged file",
            todo="export the file again",
        )
    arrays = (means, take("scale_", 3), take("rot_", 4), opacity, sh)
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(a)) for a in arrays)), origin


def _names(n_rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz"] + [f"f_dc_{i}" for i in range(3)]
    names += [f"f_rest_{i}" for i in range(n_rest)] + ["opacity"]
    return names + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]


def _parse_header(data: bytes, path: Path) -> tuple[int, np.dtype, int]:
    """Number of vertices, their record, and where the records start."""

    def fault(what: str) -> SceneError:
        return SceneError(
            what, where=path, todo="give a binary little endian point_cloud.ply as 3DGS writes it"
        )

    head, mark, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header")
    end = data.find(b"\n", len(head)) + 1
    if not data.startswith(b"ply") or not mark or not end:
        raise fault("the file is not a PLY point cloud, or its header is cut off")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise fault("the point cloud is not in binary little endian format")
    count, element = -1, None
    fields: list[tuple[str, str]] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3:
            if element is None and words[1] != "vertex":
                raise fault(f"the first element of the point cloud is {words[1]!r}, not 'vertex'")
            element = words[1]
            if element == "vertex":
                if not words[2].isdecimal():
                    raise fault(f"the number of vertices reads {words[2]!r}")
                count = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(fields):
                raise fault(f"the header's line {' '.join(words)!r} is not understood")
            fields.append((words[2], _TYPES[words[1]]))
    if count < 0 or not fields:
        raise fault("the point cloud's header names no vertices")
    return count, np.dtype(fields), end
