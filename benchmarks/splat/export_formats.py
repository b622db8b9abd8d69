"""What exported files lose: PSNR of each format against the run's own renders, and Chamfer distance of its meshes.

    python benchmarks/splat/export_formats.py RUN

Pictures are of the test views, on white. Distances are root mean squares over 100,000 points in hundredths of the
true surface's longest side, which only the built-in scene and scenes with a mesh file have. Formats that need Node
are left out where there is none.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from visdom_plugin.cli.runs import open_run
from visdom_plugin.errors import ConfigError
from visdom_plugin.export import meshes, splat_files
from visdom_plugin.export.fusion import fuse
from visdom_plugin.geometry.local_frame import local_origin, mean_distance
from visdom_plugin.hull.queries.surface_distance import compare_points, draw_on_surface
from visdom_plugin.render import quantise
from visdom_plugin.splat.rasterise import NEAR, rasterise
from visdom_plugin.training.evaluate import carve_reference, render_on_white

POINTS = 100_000


def compare_splats(method, scene, path: Path) -> None:
    cameras, origin = scene.test.cameras, local_origin(scene.train.cameras)
    near = NEAR * float(mean_distance(scene.train.cameras))
    own = [quantise(render_on_white(method, cameras[i], torch.device("cpu"))[0]) for i in range(len(cameras))]
    with tempfile.TemporaryDirectory() as folder:
        method.export(Path(folder))
        gaussians = splat_files.read_splats(Path(folder) / "point_cloud.ply", origin)
        for kind in ("ply", "spz", "splat", "sog"):
            file = Path(folder) / f"a.{kind}"
            began = time.process_time()
            try:
                splat_files.write_splats(file, gaussians, origin)
                back = splat_files.read_splats(file, origin)
            except ConfigError as error:
                print(f"{kind:6s} left out: {error.what}")
                continue
            seconds = time.process_time() - began
            white = torch.ones(3)
            errors = [
                (quantise(rasterise(back, cameras[i].relative_to(origin), white, near=near).rgb) - own[i])
                .square()
                .mean()
                for i in range(len(cameras))
            ]
            psnr = float(-10 * torch.stack(errors).mean().clamp_min(1e-12).log10())
            print(
                f"{kind:6s} {file.stat().st_size:9d} bytes  {psnr:6.2f} dB  {seconds:.1f} CPU s of Python's own"
            )


def compare_meshes(method, scene, hull) -> None:
    if scene.mesh is None:
        return
    vertices, faces = (x.numpy() for x in scene.mesh)
    target = draw_on_surface(vertices, faces, POINTS, 0)
    size = float(np.ptp(vertices, axis=0).max())

    def score(name: str, mesh: meshes.Mesh) -> None:
        found = compare_points(target, draw_on_surface(mesh.vertices, mesh.faces, POINTS, 1))
        there, back = (100 * d**0.5 / size for d in (found.target_to_hull, found.hull_to_target))
        print(f"{name:28s} {there:5.2f} to the mesh, {back:5.2f} back, {len(mesh.faces)} triangles")

    score("hull", meshes.Mesh(*hull.to_mesh()))
    if hasattr(method, "mesh") and (own := method.mesh()) is not None:
        score("density, marching cubes", meshes.Mesh(*own))
    began = time.process_time()
    fused = fuse(method, scene.train.cameras, hull.extent, inside=lambda x: hull.contains(x, margin_voxels=1))
    seconds = time.process_time() - began
    if fused is not None:
        score("depth, fused", fused)
        score("... as visdom-export has it", meshes.smooth(meshes.largest_pieces(fused, 0.005), 2))
        print(f"fusion: {seconds:.1f} CPU s")


def main(run: Path) -> None:
    _, _, scene, method, hull, _, _ = open_run(run, None, "cpu")
    if hasattr(method, "splats"):
        compare_splats(method, scene, run)
    compare_meshes(method, scene, hull or carve_reference(scene.train))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
