"""What poses refined by silhouettes gain: errors before and after on the built-in scene with noise in its poses.

    python benchmarks/hull/refine_poses.py [--views 6 9] [--degrees 0.5 1 2] [--seeds 3] [--size 200]

"pointing" is by how many degrees a camera sees the surface in another direction than in truth, after the best
similarity of the surface: what blurs a reconstruction. "turned" is the angle between the camera and the true one.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.geometry.pointing import pointing_error
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.refine.poses import refine_poses


def turned_deg(cameras: Cameras, true: Cameras) -> np.ndarray:
    """(N,) degrees between orientations."""
    turn = cameras.world_from_camera[:, :3, :3].mT @ true.world_from_camera[:, :3, :3]
    cosine = (turn.diagonal(dim1=1, dim2=2).sum(-1).numpy() - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[6, 9])
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=200)
    options = parser.parse_args()
    print("| views | noise | pointing, before | after | times, mean | least | turned, before | after | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for views in options.views:
        for degrees in options.degrees:
            rows = []
            for seed in range(options.seeds):
                base = {"size": options.size, "train_views": views, "test_views": 0, "seed": seed}
                true = make_scene(SyntheticConfig(**base))
                noisy = make_scene(SyntheticConfig(**base, rotation_noise_deg=degrees)).train
                surface = np.asarray(true.mesh[0])
                surface = surface[:: max(1, len(surface) // 400)]
                began = time.perf_counter()
                found = refine_poses(noisy.cameras, noisy.masks)
                seconds = time.perf_counter() - began
                row = []
                for cameras in (noisy.cameras, found.cameras):
                    row += [
                        pointing_error(cameras, true.train.cameras, surface).mean(),
                        turned_deg(cameras, true.train.cameras).mean(),
                    ]
                rows.append([*row, seconds])
            before, turned, after, left, seconds = np.array(rows).T
            print(
                f"| {views} | {degrees:g} | {before.mean():.3f} | {after.mean():.3f} | "
                f"{before.mean() / after.mean():.1f} | {(before / after).min():.1f} | "
                f"{turned.mean():.2f} | {left.mean():.2f} | {seconds.mean():.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
