"""How well hulls and the shapes inside them fit training and unseen masks.

    python benchmarks/hull/inner_shape.py [--data DIR ...] [--views 4] [-k 3] [--downscale 4] [--radius 2 ...]

Prints for hull and inner shape of every scene the silhouette IoU in training and in test views (means over views),
the least share of a training mask that is covered, the volume as a share of the hull's, and the seconds. Without
--data: the built-in scene and every folder under VISDOM_SCENES.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from datamodules import load
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.inside.config import InsideConfig
from visdom_plugin.hull.inside.shape import shape_inside
from visdom_plugin.hull.queries.raycast import depth_and_silhouette


def fit(hull: Hull, views) -> tuple[float, float]:
    """Mean IoU of the views' masks with the hull's silhouettes, and the least share of a mask covered."""
    ious, covered = [], []
    for i in range(len(views)):
        seen, mask = depth_and_silhouette(hull, views.cameras[i])[1].numpy(), views.masks[i].numpy()
        ious.append((seen & mask).sum() / max((seen | mask).sum(), 1))
        covered.append((seen & mask).sum() / max(mask.sum(), 1))
    return float(np.mean(ious)), float(np.min(covered))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    scenes = os.environ.get("VISDOM_SCENES")
    folders = sorted(p for p in Path(scenes).iterdir() if p.is_dir()) if scenes else []
    parser.add_argument("--data", type=Path, nargs="+", default=[None, *folders])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("-k", type=int, default=3)
    parser.add_argument("--downscale", type=float, default=4.0)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--radius", type=float, nargs="+", default=[InsideConfig().radius])
    options = parser.parse_args()
    print("| scene | shape | IoU train | IoU test | covered | volume | s |\n|" + " --- |" * 7)
    for folder in options.data:
        scene = load(folder, views=options.views, downscale=options.downscale)
        domain = VisibleDomain(k=options.k, resolution=options.resolution)
        hull = domain.carve(*scene.train.silhouettes())
        shapes = {"hull": hull}
        for radius in options.radius:
            inner = shape_inside(hull, *scene.train.silhouettes(), config=InsideConfig(radius=radius))
            shapes[f"R = {radius:g}"] = inner
        for name, shape in shapes.items():
            train, covered = fit(shape, scene.train)
            test, _ = fit(shape, scene.test)
            title = "built-in" if folder is None else folder.name
            print(
                f"| {title} | {name} | {train:.4f} | {test:.4f} | {covered:.4f} | "
                f"{shape.volume / hull.volume:.3f} | {shape.summary['seconds']:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
