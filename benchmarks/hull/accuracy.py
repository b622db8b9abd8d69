"""How close each hull comes to the exact surface of the built-in scene, and what a grid costs on disk.

    python benchmarks/hull/accuracy.py [--views 4 6 9] [--resolution 256] [--samples 200000]

Chamfer distance: mean of the two mean distances between points drawn evenly on both surfaces, in per cent of the
object's diagonal. "outside" is the part of it from the hull to the object, "missed" the part from the object to
the hull; "inside" is the share of points drawn in the object's surface that the hull contains within a voxel.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from datamodules import load
from visdom_plugin.errors import EmptyHullError
from visdom_plugin.hull.domain import VisibleDomain


def draw_on(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) points, uniform by area."""
    random = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = random.choice(len(faces), count, p=area / area.sum())
    root, other = np.sqrt(random.random(count))[:, None], random.random(count)[:, None]
    return (1 - root) * a[chosen] + root * (1 - other) * b[chosen] + root * other * c[chosen]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, nargs="+", default=[4, 6, 9])
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--samples", type=int, default=200_000)
    options = parser.parse_args()
    settings = {f"visdom, K = {k}": {"k": k} for k in (1, 2, 3, 4)}
    settings |= {kind: {"kind": kind} for kind in ("traditional", "unit-sphere", "released-go")}
    for views in options.views:
        scene = load(None, views=views)
        truth = draw_on(*(x.numpy() for x in scene.mesh), options.samples)
        size = float(np.linalg.norm(np.ptp(truth, axis=0)))
        tree = cKDTree(truth)
        print(f"\n{views} views                 Chamfer %  outside %  missed %  inside %     volume  pieces")
        for name, fields in settings.items():
            domain = VisibleDomain(resolution=options.resolution, **fields)
            try:
                hull = domain.carve(scene.train.cameras, scene.train.masks)
            except EmptyHullError:
                print(f"{name:20s} empty")
                continue
            points = hull.sample_points(options.samples, torch.Generator().manual_seed(0)).numpy()
            outside, missed = tree.query(points)[0].mean(), cKDTree(points).query(truth)[0].mean()
            inside = hull.contains(truth, margin_voxels=1).mean()
            print(
                f"{name:20s} {50 * (outside + missed) / size:14.3f} {100 * outside / size:10.3f} "
                f"{100 * missed / size:9.3f} {100 * inside:9.2f} {hull.volume:10.4g} "
                f"{hull.summary['components']:7d}"
            )
    scene = load(None, views=options.views[0])
    print(f"\n{options.views[0]} views: resolution   seconds  grid bytes  .npz bytes  .ply bytes")
    for resolution in (64, 128, 256, 512):
        hull = VisibleDomain(resolution=resolution).carve(scene.train.cameras, scene.train.masks)
        with tempfile.TemporaryDirectory() as folder:
            hull.save(Path(folder) / "hull.npz")
            hull.write_ply(Path(folder) / "hull.ply")
            sizes = [(Path(folder) / f"hull.{suffix}").stat().st_size for suffix in ("npz", "ply")]
        seconds = hull.summary["seconds"]
        print(f"{resolution:19d} {seconds:9.3f} {hull.occupancy.nbytes:11d} {sizes[0]:11d} {sizes[1]:11d}")


if __name__ == "__main__":
    main()
