"""What `visdom-check` finds: faults planted into the built-in scene and real ones, and what sound scenes are told.

    python benchmarks/hull/check_faults.py --views 4 6 9
    python benchmarks/hull/check_faults.py --scenes built-in vgg_dinosaur synthetic_lego --downscale 4 --clean all

Scenes are folders in VISDOM_SCENES. A fault counts as found when a finding of the right kind names every view
concerned: alone ("+", with how sure) or as one of several suspects or causes ("~": nothing in the masks can tell
them apart). "!" marks findings beside it. Views from similar directions are planted by taking the nearest of a
dense capture. Prints Markdown.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from datamodules import load
from tests.hull.checks.faults import FAULTS, Capture, capture_of, clustered, judge
from visdom_plugin.hull.checks.check import check

REAL = ("blowtorch", "middlebury_temple", "mother_child", "studio_human", "synthetic_lego", "vgg_dinosaur")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["built-in", "vgg_dinosaur", "synthetic_lego"])
    parser.add_argument("--clean", nargs="*", default=["built-in", *REAL], help="sound scenes to look at")
    parser.add_argument("--views", type=int, nargs="*", default=[4, 6, 9])
    parser.add_argument("--downscale", type=float, default=4, help="of the real scenes")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS))
    parser.add_argument("--view", type=int, default=1, help="position of the view the fault is put into")
    options = parser.parse_args()
    warm = open_capture("built-in", 4, 1)
    check(warm.cameras, warm.masks, warm.images, warm.names)

    print("| sound scene | views | findings | notes | misfit, % of the object | K | CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    alarms = 0
    for name in options.clean:
        for count in options.views:
            capture = open_capture(name, count, options.downscale)
            found, seconds = timed(capture)
            alarms += len(found.findings)
            said = "; ".join(f.what for f in found.findings) or "none"
            notes = "; ".join(f"{f.kind} {len(f.views)}" for f in found.notes) or "none"
            misfit = 100 * found.fit.score / 128
            print(
                f"| {name} | {count} | {said} | {notes} | {misfit:.3f} | {found.advice.k} | {seconds:.2f} |"
            )

    columns = [(name, count) for name in options.scenes for count in options.views]
    captures = {c: open_capture(*c, options.downscale) for c in columns}
    print("\n| fault | " + " | ".join(f"{n} {c}" for n, c in columns) + " | CPU s, most |")
    print("| --- |" + " --- |" * (len(columns) + 1))
    totals = {"+": 0, "~": 0, "missed": 0}
    for name in options.faults:
        cells, slowest = [], 0.0
        for column in columns:
            fault = FAULTS[name](captures[column], options.view)
            found, seconds = timed(fault.capture)
            slowest = max(slowest, seconds)
            verdict = judge(fault, found)
            totals[verdict.mark] += 1
            cells.append(f"{verdict.mark} {verdict.sure}{' !' * verdict.beside}".strip())
        print(f"| {name} | " + " | ".join(cells) + f" | {slowest:.2f} |", flush=True)
    cells = []
    for name, _ in columns:
        dense = open_dense(name, options.downscale)
        fault = clustered(dense, options.view, count=3)
        verdict = judge(fault, check(fault.capture.cameras, fault.capture.masks))
        totals[verdict.mark] += 1
        cells.append(f"{verdict.mark} {verdict.sure}{' !' * verdict.beside}".strip())
    print("| clustered, 3 views | " + " | ".join(cells) + " | |")
    print(
        f"\n{sum(totals.values())} faults: {totals['+']} found and named, {totals['~']} found among several, "
        f"{totals['missed']} missed; {alarms} false alarms in {len(options.clean) * len(options.views)} scenes"
    )


def open_capture(name: str, views: int, downscale: float) -> Capture:
    if name == "built-in":
        return capture_of(load(None, views=views, test=False).train)
    root = os.environ.get("VISDOM_SCENES")
    if not root:
        sys.exit("set VISDOM_SCENES to the folder of real scenes, or pass --scenes built-in --clean built-in")
    return capture_of(load(Path(root) / name, views=views, downscale=downscale, test=False).train)


def open_dense(name: str, downscale: float) -> Capture:
    if name == "built-in":
        return open_capture(name, 16, downscale)
    root = Path(os.environ["VISDOM_SCENES"]) / name
    wanted = ",".join(map(str, range(36)))
    return capture_of(load(root, train_list=wanted, views=None, downscale=downscale, test=False).train)


def timed(capture: Capture):
    started = time.process_time()
    found = check(capture.cameras, capture.masks, capture.images, capture.names)
    return found, time.process_time() - started


if __name__ == "__main__":
    main()
