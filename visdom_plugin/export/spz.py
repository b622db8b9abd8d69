"""SPZ, Niantic's compressed Gaussians (version 3, and versions 2 and 3 read).

A gzip stream: a header of 16 bytes, then, over all Gaussians, positions (24-bit fixed point), opacities, colours,
scales, rotations (the three smallest components, 10 bits each) and harmonics (a byte each). Its axes are x right,
y up, z back, those of a PLY file x right, y down, z ahead: everything is turned by half a turn about x on its way.
"""

from __future__ import annotations

import gzip
import itertools
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.errors import SceneError
from visdom_plugin.export.splats import move
from visdom_plugin.splat.gaussians import Gaussians

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_COLOUR = 0.15 * 255
"""Steps per unit of the harmonics' constant."""
_PLACES = (1 << 23) - 1
_MOST_BITS = 20
_AXES = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def write_spz(path: Path, gaussians: Gaussians, origin: Tensor | None = None) -> None:
    """Writes version 3; the file appears whole or not at all.

    Positions are rounded to the finest binary fraction with which the farthest one fits into 24 bits.

    Args:
        origin: (3,) float64 of their frame in the frame the file shall have; None for the same frame.
    """
    turned = move(gaussians.detach().to("cpu"), _AXES)
    arrays = {name: value.double().numpy() for name, value in turned.tensors().items()}
    means = arrays["means"] if origin is None else arrays["means"] + (_AXES[:3, :3] @ origin).numpy()
    farthest = max(float(np.abs(means).max(initial=0)), 1e-9)
    bits = max(0, min(_MOST_BITS, math.floor(math.log2(_PLACES / farthest))))
    fixed = np.clip((means * (1 << bits)).round(), -_PLACES, _PLACES).astype("<i4")
    degree, n = turned.degree, len(turned)
    colours = arrays["sh"][:, 0] * _COLOUR + 127.5
    parts = [
        fixed.view(np.uint8).reshape(n, 3, 4)[..., :3],
        _byte(255 / (1 + np.exp(-arrays["opacity_logits"]))),
        _byte(colours),
        _byte((arrays["log_scales"] + 10) * 16),
        _pack_rotations(arrays["quaternions"]).view(np.uint8),
        _byte(arrays["sh"][:, 1:] * 128 + 128),
    ]
    header = _HEADER.pack(_MAGIC, 3, n, degree, bits, 0, 0)
    body = header + b"".join(part.tobytes() for part in parts)
    write_bytes(path, gzip.compress(body, mtime=0))


def read_spz(path: Path) -> Gaussians:
    """Reads versions 2 and 3, float32 on the CPU, in the axes of a PLY file.

    Raises:
        SceneError: for a file that is missing, damaged, or of another kind or version.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise SceneError(f"cannot read the file: {error.strerror}", where=path) from error
    convert = "write a .ply of it: npx @playcanvas/splat-transform FILE.spz FILE.ply"
    if raw[:4] == b"NGSP":
        raise SceneError("this SPZ file is of version 4 or newer", where=path, todo=convert)
    try:
        data = gzip.decompress(raw)
        magic, version, n, degree, bits, _, _ = _HEADER.unpack_from(data)
        rest = 3 * ((degree + 1) ** 2 - 1)
        sizes = [9 * n, n, 3 * n, 3 * n, (3 if version < 3 else 4) * n, rest * n]
        if magic != _MAGIC or version not in (2, 3) or degree > 3 or len(data) < _HEADER.size + sum(sizes):
            raise ValueError("its header is of another kind, or it is cut off")
    except (OSError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise SceneError(
            f"this is no SPZ file that can be read: {error}", where=path, todo=convert
        ) from error
    ends = np.cumsum([_HEADER.size, *sizes])
    parts = [np.frombuffer(data, np.uint8, b - a, a) for a, b in itertools.pairwise(ends)]
    places = np.zeros((n, 3, 4), np.uint8)
    places[..., 1:] = parts[0].reshape(n, 3, 3)
    # The three bytes stand above an empty one, so that the sign comes along.
    means = (places.view("<i4")[..., 0] >> 8) / (1 << bits)
    alpha = (parts[1].astype(np.float64) / 255).clip(1e-4, 1 - 1e-4)
    constant = (parts[2].reshape(n, 1, 3) - 127.5) / _COLOUR
    harmonics = (parts[5].reshape(n, rest // 3, 3).astype(np.float64) - 128) / 128
    if version < 3:
        xyz = parts[4].reshape(n, 3) / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(-1, keepdims=True)))
        rotations = np.concatenate([w, xyz], 1)
    else:
        rotations = _unpack_rotations(parts[4].view("<u4"))
    arrays = (
        means,
        parts[3].reshape(n, 3) / 16 - 10,
        rotations,
        np.log(alpha / (1 - alpha)),
        np.concatenate([constant, harmonics], 1),
    )
    found = Gaussians(*(torch.from_numpy(np.ascontiguousarray(a)).float() for a in arrays))
    return move(found, _AXES)


def _byte(values: np.ndarray) -> np.ndarray:
    return values.round().clip(0, 255).astype(np.uint8)


def _pack_rotations(quaternions: np.ndarray) -> np.ndarray:
    """(n,) uint32: number of the largest component, then the others in order x y z w, each sign and 9 bits."""
    xyzw = quaternions[:, [1, 2, 3, 0]] / np.linalg.norm(quaternions, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(1)
    flip = np.take_along_axis(xyzw, largest[:, None], 1)[:, 0] < 0
    packed = largest.astype(np.uint32)
    for i in range(4):
        value = xyzw[:, i]
        size = (np.abs(value) * math.sqrt(2) * 511).round().clip(0, 511).astype(np.uint32)
        word = ((value < 0) ^ flip).astype(np.uint32) << 9 | size
        packed = np.where(largest == i, packed, packed << 10 | word)
    return packed.astype("<u4")


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    """(n, 4) in the order w x y z, the inverse of `_pack_rotations`."""
    largest, rest = packed >> 30, packed.astype(np.uint32)
    xyzw = np.zeros((len(packed), 4))
    for i in (3, 2, 1, 0):
        value = (rest & 511) / (math.sqrt(2) * 511) * np.where(rest >> 9 & 1, -1.0, 1.0)
        other = largest != i
        xyzw[other, i] = value[other]
        rest = np.where(other, rest >> 10, rest)
    whole = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(1)))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), whole[:, None], 1)
    return xyzw[:, [3, 0, 1, 2]]
