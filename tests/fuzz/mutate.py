"""Damage done to valid files: at random, and where a format is most sensitive."""

from __future__ import annotations

import copy
import json
import random
import struct
import zlib

_U64 = (0, 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1, 10**12)
_F64 = (0.0, -0.0, 1e-320, 1e308, -1e308, 1e16, float("nan"), float("inf"), float("-inf"), 2.0**63)
_WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"9" * 400, b"9" * 5000, b"1e308", b"../x", b"/etc/passwd",
    b"C:\\x", b"\xff\xfe", b"\x00", b"", b" ", b"\n", b"\n\n", b'"', b",", b"#", b"PINHOLE", b"OPENCV",
    b"\xe2\x80\xae", b"0x10", b"1_0", b"18446744073709551616", b"4294967296", b"[" * 3000, b"{}", b"null", b"true",
)  # fmt: skip
_VALUES = (
    None, True, False, 0, -1, 1e308, 10**18, 10**400, float("nan"), float("inf"), "", "x", "../../etc/passwd",
    "/etc/passwd", "C:\\x.png", "a\0b", "\ud800", "x" * 9000, [], {}, [[]], [1, 2], {"a": 1}, "images/v00.png",
    "OPENCV_FISHEYE", "EQUIRECTANGULAR", [[0, 0, 0, 0]] * 4, [[1e300] * 4] * 4,
)  # fmt: skip


def damage(data: bytes, draw: random.Random, others: list[bytes]) -> bytes:
    """One to four faults: flips, special numbers, cuts, insertions, repetitions, pieces of other files."""
    out = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        at = draw.randrange(len(out) + 1)
        kind = draw.randrange(10)
        if kind == 0 and out:
            at = min(at, len(out) - 1)
            out[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            out[at : at + 1] = bytes([draw.choice((0, 1, 9, 10, 32, 0x7F, 0x80, 0xFF, draw.randrange(256)))])
        elif kind == 2:
            out[at : at + 8] = struct.pack("<Q", draw.choice(_U64))
        elif kind == 3:
            out[at : at + 8] = struct.pack("<d", draw.choice(_F64))
        elif kind == 4:
            del out[at:]
        elif kind == 5:
            del out[at : at + draw.choice((1, 2, 8, 24, 200))]
        elif kind == 6:
            out[at:at] = draw.choice(_WORDS)
        elif kind == 7:
            piece = out[at : at + draw.choice((1, 8, 64, 400))]
            out[at:at] = piece * draw.choice((1, 1, 2, 50))
        elif kind == 8:
            other = draw.choice(others)
            start = draw.randrange(len(other) + 1)
            out[at : at + 16] = other[start : start + draw.choice((4, 16, 100))]
        else:
            end = at
            while end < len(out) and out[end] not in b" ,\n":
                end += 1
            out[at:end] = draw.choice(_WORDS)
    return bytes(out[: 2**17])


def damage_json(data: bytes, draw: random.Random, others: list[bytes]) -> bytes:
    """Half of the time a value of the tree is replaced by another type or a hostile one, else bytes."""
    if draw.random() < 0.4:
        return damage(data, draw, others)
    tree = copy.deepcopy(json.loads(data))
    for _ in range(draw.choice((1, 1, 2, 3))):
        node, key = tree, None
        for _ in range(draw.randrange(1, 6)):
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = draw.choice(keys)
            if not isinstance(node[key], dict | list) or draw.random() < 0.2:
                break
            node, key = (node[key], None) if node[key] else (node, key)
        if key is None:
            continue
        if draw.random() < 0.15:
            del node[key]
        else:
            node[key] = copy.deepcopy(draw.choice(_VALUES))
    text = json.dumps(tree)
    if draw.random() < 0.02:
        text = text.replace(":", ":" + "[" * draw.choice((10, 2000, 60000)), 1)
    return text.encode("utf-8", "surrogatepass")


def damage_png(data: bytes, draw: random.Random, others: list[bytes]) -> bytes:
    """Damage within chunks whose checksums are then made right again, or damage of any bytes."""
    if draw.random() < 0.3:
        return damage(data, draw, others)
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + length]])
        at += 12 + length
    i = draw.choice((0, draw.randrange(len(chunks))))
    if i == 0 and draw.random() < 0.7:
        header = bytearray(chunks[0][1])
        if draw.random() < 0.5:
            header[draw.randrange(8)] = draw.choice((0, 1, 0x7F, 0xFF, draw.randrange(256)))
        else:
            header[8 + draw.randrange(5)] = draw.randrange(18)
        chunks[0][1] = bytes(header)
    else:
        chunks[i][1] = damage(chunks[i][1], draw, others)
    if draw.random() < 0.1:
        chunks.insert(draw.randrange(len(chunks)), list(draw.choice(chunks)))
    parts = [data[:8]]
    for kind, body in chunks:
        parts.append(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))
    return b"".join(parts)
