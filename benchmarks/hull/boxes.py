"""How well the automatic box fits the object, with each way to choose among the pieces of a hull.

    python benchmarks/hull/boxes.py [DIR ...] [--views 4 6 9] [--resolution 256]

Without DIR: the built-in scene. The object is the largest piece of the hull from the most views. Printed are the
extent of what is kept over that of the object for each axis, and the least and the mean share of a mask covered.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from datamodules import load
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="*", default=[None])
    parser.add_argument("--views", type=int, nargs="+", default=[4, 6, 9])
    parser.add_argument("--resolution", type=int, default=256)
    options = parser.parse_args()
    for folder in options.folders:
        train = load(folder, views=max(options.views)).train
        whole = VisibleDomain(components="largest", resolution=options.resolution)
        size = np.diff(whole.carve(train.cameras, train.masks).extent, axis=0)[0]
        for views in options.views:
            train = load(folder, views=views).train
            for components in ("drop-small", "explain"):
                domain = VisibleDomain(components=components, resolution=options.resolution)
                hull = domain.carve(train.cameras, train.masks)
                ratio = np.diff(hull.extent, axis=0)[0] / size
                covered = [c.covered for c in measure_coverage(hull, train.cameras, train.masks)]
                print(
                    f"| {folder.name if folder else 'built-in'} | {views} | {components} | "
                    f"{' '.join(f'{r:.2f}' for r in ratio)} | {min(covered):.4f} | {np.mean(covered):.4f} | "
                    f"{hull.summary['components']} of {hull.summary['components_found']} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
