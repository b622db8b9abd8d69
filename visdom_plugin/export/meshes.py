"""Triangle meshes with vertex colours: cleaned, cropped, and written as PLY, OBJ and GLB."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.geometry.mesh_files import mesh_ply

FORMATS = ("ply", "obj", "glb")


class Mesh(NamedTuple):
    """A triangle mesh."""

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """(F, 3) int64, anticlockwise seen from outside."""
    rgb: np.ndarray | None = None
    """(V, 3) uint8 sRGB, or None."""


def keep_faces(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The mesh with some faces, and the vertices that they use.

    Args:
        kept: (F,) bool, or numbers of faces.
    """
    faces = mesh.faces[kept]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], index.reshape(-1, 3), None if mesh.rgb is None else mesh.rgb[used])


def largest_pieces(mesh: Mesh, share: float) -> Mesh:
    """Leaves out the pieces that have fewer faces than `share` of the largest one's."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(mesh.faces):
        return mesh
    a, b = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    size = len(mesh.vertices)
    links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(size, size))
    piece = connected_components(links, directed=False)[1][mesh.faces[:, 0]]
    counts = np.bincount(piece)
    return keep_faces(mesh, counts[piece] >= share * counts.max())


def smooth(mesh: Mesh, rounds: int) -> Mesh:
    """Taubin's smoothing, which does not shrink (1995); colours stay."""
    if not rounds or not len(mesh.faces):
        return mesh
    from trimesh import Trimesh
    from trimesh.smoothing import filter_taubin

    surface = Trimesh(mesh.vertices.copy(), mesh.faces, process=False)
    filter_taubin(surface, lamb=0.5, nu=0.53, iterations=2 * rounds)
    return mesh._replace(vertices=np.asarray(surface.vertices))


def crop(mesh: Mesh, inside: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """Leaves out the faces that have a corner outside; `inside` takes points (n, 3) to (n,) bool."""
    return keep_faces(mesh, inside(mesh.vertices)[mesh.faces].all(-1))


def move(mesh: Mesh, motion: np.ndarray) -> Mesh:
    """The mesh moved by a rigid motion (4, 4)."""
    return mesh._replace(vertices=mesh.vertices @ motion[:3, :3].T + motion[:3, 3])


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Writes a mesh by the suffix of its path: .ply, .obj or .glb. The file appears whole or not at all."""
    writer = {".ply": lambda m: mesh_ply(*m), ".obj": mesh_obj, ".glb": mesh_glb}[path.suffix.lower()]
    write_bytes(path, writer(mesh))


def mesh_obj(mesh: Mesh) -> bytes:
    """Wavefront OBJ; colours stand behind the coordinates, as Blender and MeshLab read them.

    Coordinates have as many digits as tell a ten millionth of the mesh's size, however far the origin is.
    """
    parts = [mesh.vertices] if mesh.rgb is None else [mesh.vertices, mesh.rgb / 255]
    size = float(np.ptp(mesh.vertices, axis=0).max(initial=0)) if len(mesh.vertices) else 0.0
    digits = max(0, 7 - math.floor(math.log10(size))) if size > 0 else 7
    words = f"v %.{digits}f %.{digits}f %.{digits}f" + " %.4f %.4f %.4f" * (len(parts) - 1)
    lines = [words % tuple(row) for row in np.concatenate(parts, 1).tolist()]
    lines += ["f %d %d %d" % tuple(row) for row in (mesh.faces + 1).tolist()]  # noqa: UP031
    return ("\n".join(lines) + "\n").encode()


def mesh_glb(mesh: Mesh) -> bytes:
    """Binary glTF 2.0: one mesh, drawn in its own colours and without light.

    Positions are float32 from the middle of the mesh, and the node holds that middle, so that a frame far from its
    origin loses nothing. glTF's vertex colours are linear, ours are sRGB: they are converted, to 16 bits.
    """
    from trimesh import Trimesh

    middle = mesh.vertices.mean(0) if len(mesh.vertices) else np.zeros(3)
    positions = (mesh.vertices - middle).astype("<f4")
    normals = np.asarray(Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals, "<f4")
    blocks = [("POSITION", positions, 5126, "VEC3", 34962), ("NORMAL", normals, 5126, "VEC3", 34962)]
    if mesh.rgb is not None:
        srgb = mesh.rgb / 255
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        rgba = np.concatenate([linear, np.ones((len(linear), 1))], 1)
        blocks.append(("COLOR_0", (rgba * 65535).round().astype("<u2"), 5123, "VEC4", 34962))
    blocks.append(("", mesh.faces.astype("<u4").reshape(-1), 5125, "SCALAR", 34963))
    binary, views, accessors = b"", [], []
    for name, array, kind, shape, target in blocks:
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data), "target": target})
        accessor = {"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape}
        if name == "POSITION" and len(array):
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        accessors.append(accessor | ({"normalized": True} if name == "COLOR_0" else {}))
        binary += data + b"\0" * (-len(data) % 4)
    attributes = {name: i for i, (name, *_) in enumerate(blocks) if name}
    unlit = "KHR_materials_unlit"
    document = {
        "asset": {"version": "2.0", "generator": "visdom-plugin"},
        "extensionsUsed": [unlit],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": middle.tolist()}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(blocks) - 1, "material": 0}]}],
        "materials": [
            {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "extensions": {unlit: {}}}
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return b"".join(
        [
            head,
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )
