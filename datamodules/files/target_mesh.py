"""The true surface of a scene on disk, where there is a mesh file of it.

Looked for in the scene's folder: mesh.<suffix>, or of a video layout the one file of meshes/ whose name ends in
the number of the frame (mesh_000015.obj). It must be in the frame and units of the cameras.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datamodules.files.paths import inside, read_plain
from visdom_plugin.errors import SceneError, list_some

SUFFIXES = (".ply", ".obj", ".off", ".stl")
_FAR = 0.25
"""How far the mesh's box may be off the actor's, in diagonals of that one."""


def find_mesh(root: Path, frame: int | None = None) -> Path | None:
    """The mesh file of a scene's folder; None where there is none.

    Args:
        frame: of a video layout.

    Raises:
        SceneError: more than one file could be meant, or one leads out of the folder.
    """
    root = Path(root)
    found = [p for p in sorted(root.glob("mesh.*")) if p.suffix.lower() in SUFFIXES]
    if frame is not None:
        found = [
            p
            for p in sorted((root / "meshes").glob("*"))
            if p.suffix.lower() in SUFFIXES and (m := re.search(r"(\d+)$", p.stem)) and int(m[1]) == frame
        ] or found
    if len(found) > 1:
        raise SceneError(
            f"there are {len(found)} meshes of the true surface: {list_some((p.name for p in found), 4)}",
            where=root,
            todo="keep one of them, or name it with --method.target",
        )
    return inside(root, found[0].relative_to(root).as_posix()) if found else None


def load_mesh(path: Path, box: list[list[float]] | None = None) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) float64 and faces (F, 3) int64 of a mesh file; corners at one place become one.

    Args:
        box: corners of where the object is known to be, if so; a mesh elsewhere is refused.

    Raises:
        SceneError: the file is missing, is no triangle mesh, or lies elsewhere.
    """
    import io

    import trimesh

    path = Path(path)
    try:
        data = io.BytesIO(read_plain(path))
        mesh: Any = trimesh.load(data, file_type=path.suffix.lower().lstrip("."), process=False, force="mesh")
        # Files of some kinds name each triangle's corners anew.
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    except Exception as error:  # trimesh's readers raise whatever they come across
        raise SceneError(
            f"the mesh of the true surface cannot be read: {str(error)[:200] or type(error).__name__}",
            where=path,
            todo=f"give a triangle mesh ({', '.join(SUFFIXES)})",
        ) from error
    if not len(faces) or not np.isfinite(vertices).all():
        raise SceneError(
            "the mesh of the true surface has no triangles, or has no finite corners", where=path
        )
    if box is not None:
        known = np.asarray(box, np.float64)
        off = np.abs(np.stack([vertices.min(0), vertices.max(0)]) - known).max()
        if off > _FAR * np.linalg.norm(known[1] - known[0]):
            raise SceneError(
                f"the mesh lies in {vertices.min(0).round(2)} .. {vertices.max(0).round(2)}, the object in "
                f"{known[0].round(2)} .. {known[1].round(2)}",
                where=path,
                cause="another frame, other units or other axes",
                todo="bring it into the frame and units of the cameras",
            )
    return torch.from_numpy(vertices), torch.from_numpy(faces)
