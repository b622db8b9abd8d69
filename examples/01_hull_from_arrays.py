"""A hull from arrays: cameras and masks in, mesh, volume and bounds of rays out.

All it needs are intrinsics, poses and masks as arrays. Here they are those of a built-in scene.

    python examples/01_hull_from_arrays.py
    python examples/01_hull_from_arrays.py --k 2 --resolution 64 --out duck.ply
"""

from pathlib import Path

import numpy as np
import tyro

import visdom_plugin as vd


def main(k: int = 3, resolution: int = 128, out: Path = Path("hull.ply")) -> None:
    """Carves the hull of a duck.

    Args:
        k: fewest views that must see a voxel.
        resolution: voxels along the longest side.
        out: mesh to write.
    """
    views = vd.load("builtin:duck", views=6).train
    intrinsics = views.cameras.intrinsics.numpy()  # (N, 3, 3) pixels
    poses = views.cameras.world_from_camera.numpy()  # (N, 4, 4) camera to world
    masks = np.stack([mask.numpy() for mask in views.masks])  # (N, H, W) bool, True on the object

    height, width = masks.shape[1:]
    # "opencv": y down, z forward. Poses of Blender, nerfstudio or NeRF's transforms.json are "opengl".
    cameras = vd.Cameras.from_matrices(intrinsics, poses, width=width, height=height, convention="opencv")
    hull = vd.VisibleDomain(k=k, resolution=resolution).carve(cameras, masks)

    print(f"{hull.voxels} voxels of {hull.voxel_size:.4f}, volume {hull.volume:.3f}")
    print(f"a voxel is {hull.summary['agreement_means']}")
    hull.write_ply(out)
    print(f"{out}: a mesh")

    # Where the rays through the middle of each photograph may meet the object:
    origins, directions = (np.asarray(x) for x in (cameras.centres, cameras.forward))
    near, far, hit = vd.VisDomSampler(hull, cameras=cameras)(origins, directions, 0.1, 20.0)
    for i in range(len(cameras)):
        print(f"{views.names[i]}: {f'{near[i]:.2f} to {far[i]:.2f}' if hit[i] else 'meets nothing'}")


if __name__ == "__main__":
    tyro.cli(main)
