"""Rays per second against a 256^3 hull: voxel traversal, torch marching, and trimesh on the hull's mesh.

python benchmarks/hull/raycast.py [--rays 2000000]
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from carve import least, made_up

from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.bricks import build_bricks
from visdom_plugin.hull.queries.raycast import cast, cast_with_torch, depth_and_silhouette


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rays", type=int, default=2_000_000)
    count = parser.parse_args().rays
    cameras, masks = made_up()
    hull = VisibleDomain(resolution=256).carve(cameras, masks)
    random = torch.Generator().manual_seed(0)
    view = torch.randint(len(cameras), (count,), generator=random)
    uv = 800 * torch.rand(count, 1, 2, generator=random, dtype=torch.float64)
    pixels = rays_of(cameras[view], uv)
    batches = {"random pixels of all views": (pixels.origins[:, 0].float(), pixels.directions[:, 0].float())}
    rays = rays_of(cameras[0].resized(1600, 1600))
    batches["one view, in order"] = (
        rays.origins.reshape(-1, 3).float(),
        rays.directions.reshape(-1, 3).float(),
    )
    shell = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1) * 4
    target = torch.from_numpy(hull.bounds.mean(0)) + (torch.rand(count, 3, generator=random) - 0.5) * float(
        0.9 * (hull.extent[1] - hull.extent[0]).min()
    )
    batches["from a sphere to points in the box"] = (shell, (target - shell).float())
    print(f"hull {hull.shape}, {hull.voxels} voxels; {torch.get_num_threads()} threads; first and last hit")
    build_bricks(hull.occupancy)
    print(f"bricks: {least(lambda: build_bricks(hull.occupancy), 3) * 1000:.0f} ms, once per hull")
    for name, (origins, directions) in batches.items():
        hits = cast(hull, origins, directions).hit.float().mean()
        seconds = least(lambda o=origins, d=directions: cast(hull, o, d), 5)
        print(f"{name:36s} {len(directions) / seconds / 1e6:6.2f} M rays/s, {hits:.0%} hit")
    origins, directions = (x[:100_000] for x in batches["random pixels of all views"])
    seconds = least(lambda: cast_with_torch(hull, origins, directions), 2)
    walked, marched = cast(hull, origins, directions), cast_with_torch(hull, origins, directions)
    off = (walked.t_first - marched.t_first).abs().max() / hull.voxel_size
    print(
        f"{'torch marching on the CPU':36s} {0.1 / seconds:6.2f} M rays/s, at most {float(off):.1e} voxels off"
    )
    camera = cameras[0].resized(200, 200)
    print(f"silhouette of 200 x 200: {least(lambda: depth_and_silhouette(hull, camera), 9) * 1000:.1f} ms")
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        print("trimesh with embree is not installed: no mesh reference")
        return
    mesh = trimesh.Trimesh(*hull.to_mesh(), process=False)
    engine = RayMeshIntersector(mesh)
    o, d = (np.asarray(x[:100_000]) for x in batches["random pixels of all views"])
    seconds = least(lambda: engine.intersects_first(o, d), 2)
    print(
        f"{'embree on the mesh, first hit only':36s} {0.1 / seconds:6.2f} M rays/s, {len(mesh.faces)} faces"
    )


if __name__ == "__main__":
    main()
