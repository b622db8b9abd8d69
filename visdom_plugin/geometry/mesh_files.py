"""Meshes as binary PLY."""

from __future__ import annotations

import numpy as np

from visdom_plugin.geometry.local_frame import is_near


def mesh_ply(vertices: np.ndarray, faces: np.ndarray, rgb: np.ndarray | None = None) -> bytes:
    """A mesh as a little-endian PLY file's content.

    Coordinates are float, and double where the mesh is so far from the origin that float would move its vertices.

    Args:
        vertices: (V, 3) float64.
        faces: (F, 3) integers.
        rgb: (V, 3) uint8 colours of the vertices.
    """
    size = float(np.ptp(vertices, axis=0).max(initial=0)) if len(vertices) else 0.0
    name, kind = ("float", "<f4") if is_near(vertices, size) else ("double", "<f8")
    parts = [("xyz", kind, 3)] + ([("rgb", "u1", 3)] if rgb is not None else [])
    points = np.empty(len(vertices), np.dtype(parts))
    points["xyz"] = vertices
    colours = ""
    if rgb is not None:
        points["rgb"] = rgb
        colours = "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue"))
    triangles = np.empty(len(faces), np.dtype([("count", "u1"), ("index", "<i4", 3)]))
    triangles["count"], triangles["index"] = 3, faces
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        + "".join(f"property {name} {axis}\n" for axis in "xyz")
        + colours
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + points.tobytes() + triangles.tobytes()
