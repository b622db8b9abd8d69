"""How `visdom-check` names one camera that is turned, and by how much: the built-in scene, one view at a time.

    python benchmarks/hull/check_turned_view.py [--views 6 9] [--degrees 0.5 1 2 3] [--size 200]

A case counts as "right" when the one finding names the turned view alone, as "with angle" when it also says an
angle; "wrong" when it names another. Axes are the camera's: x turns it up and down, y left and right, z is its
viewing axis. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.hull.checks.faults import capture_of, turned_about
from visdom_plugin.hull.checks.check import check

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "slanted": (0.6, -0.7, 0.4), "z": (0, 0, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=[6, 9])
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.5, 1.0, 2.0, 3.0])
    parser.add_argument(
        "--turned", type=int, nargs="+", default=[1, 4], help="positions of the views to turn"
    )
    parser.add_argument("--axes", nargs="+", default=list(AXES), choices=list(AXES))
    parser.add_argument("--size", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| views | axes | degrees | cases | right | with angle | wrong | angle off, mean | most | CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for views in options.views:
        config = SyntheticConfig(size=options.size, train_views=views, test_views=0)
        sound = capture_of(make_scene(config).train)
        alarms = check(sound.cameras, sound.masks).findings
        print(f"| {views} | | 0 | 1 | {1 - len(alarms)} | | {len(alarms)} | | | |", flush=True)
        for axes in ([a for a in options.axes if a != "z"], [a for a in options.axes if a == "z"]):
            for degrees in options.degrees if axes else ():
                right, wrong, errors, seconds = 0, 0, [], []
                for view in options.turned:
                    for axis in axes:
                        capture = turned_about(sound, view, AXES[axis], degrees)
                        began = time.process_time()
                        found = check(capture.cameras, capture.masks).findings
                        seconds.append(time.process_time() - began)
                        named = [f.views for f in found]
                        right += named == [(view,)]
                        wrong += named not in ([], [(view,)])
                        errors += [abs(f.turned_deg - degrees) for f in found if f.turned_deg is not None]
                cases = len(options.turned) * len(axes)
                off = f"{np.mean(errors):.2f} | {max(errors):.2f}" if errors else "|"
                counts = f"{cases} | {right} | {len(errors)} | {wrong}"
                row = f"{views} | {', '.join(axes)} | {degrees:g} | {counts} | {off} | {np.mean(seconds):.1f}"
                print(f"| {row} |", flush=True)


if __name__ == "__main__":
    main()
