"""Meshes fused from runs' depth with other constants, by the silhouettes of views that nobody trained on.

A mesh is measured without a reference, by the intersection over union of its silhouette with the mask of each test
view, and so is the hull.

    python benchmarks/splat/fusion_constants.py RUN [RUN ...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from trimesh import Trimesh
from trimesh.sample import sample_surface

from visdom_plugin.cli.runs import open_run
from visdom_plugin.export import fusion
from visdom_plugin.export.meshes import Mesh, largest_pieces, smooth
from visdom_plugin.geometry.cameras import project
from visdom_plugin.scene import Views

POINTS = 2_000_000
DEFAULT = {"VIEWS": fusion.VIEWS, "TRUNCATION": fusion.TRUNCATION, "BEHIND": fusion.BEHIND}
TRIED = ({}, {"VIEWS": 0}, {"VIEWS": 96}, {"TRUNCATION": 2.0}, {"TRUNCATION": 5.0}, {"BEHIND": 0.03},
         {"BEHIND": 0.3}, {"BEHIND": 1.0})  # fmt: skip


def agreement(mesh: Mesh, views: Views) -> float:
    """Mean intersection over union of the mesh's silhouette with the masks."""
    surface = Trimesh(mesh.vertices, mesh.faces, process=False)
    points = torch.as_tensor(np.asarray(sample_surface(surface, POINTS, seed=0)[0]))
    shares = []
    for i in range(len(views)):
        width, height = views.cameras[i].size
        uv, depth = project(views.cameras[i].to(dtype=torch.float64), points)
        u, v = uv.floor().long().unbind(-1)
        seen = (u >= 0) & (v >= 0) & (u < width) & (v < height) & (depth > 0)
        drawn = torch.zeros(height, width, dtype=torch.bool)
        drawn[v[seen], u[seen]] = True
        shares.append(float((drawn & views.masks[i]).sum() / (drawn | views.masks[i]).sum()))
    return float(np.mean(shares))


def main() -> None:
    for run in map(Path, sys.argv[1:]):
        _, _, scene, method, hull, device, _ = open_run(run, None, "cpu")
        assert hull is not None, f"{run} has no hull"
        print(f"{run}: hull {agreement(Mesh(*hull.to_mesh()), scene.test):.4f}", flush=True)
        for changed in TRIED:
            with patch.multiple(fusion, **DEFAULT | changed):
                mesh = fusion.fuse(
                    method,
                    scene.train.cameras,
                    hull.extent,
                    inside=lambda x, hull=hull: hull.contains(x, margin_voxels=1),
                    device=device,
                )
            assert mesh is not None
            mesh = smooth(largest_pieces(mesh, 0.005), 2)
            what = ", ".join(f"{k} {v}" for k, v in changed.items()) or "as shipped"
            print(f"{run}: {what} {agreement(mesh, scene.test):.4f}", flush=True)


if __name__ == "__main__":
    main()
