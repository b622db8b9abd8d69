"""Quality of methods over scenes, views and seeds: each cell is one `visdom-train` command.

    python benchmarks/methods/quality.py --methods 3dgs-go 3dgs-go+mask 3dgs-go+vd --views 4 6 9 --seeds 0 1 2
    python benchmarks/methods/quality.py --data $VISDOM_SCENES/blowtorch --downscale 4 --methods 3dgs-go+vd

Words after `--` go to every `visdom-train` as they are: `-- --method.vd.weight 0.1`. Finished cells are read,
not trained again. Prints one Markdown row per scene, number of views and method: mean over seeds of the mean
over test views, with the standard deviation over seeds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path

from visdom_plugin.cli.commands.train import main as visdom_train
from visdom_plugin.cli.entry import INTERRUPTED

COLUMNS = (
    ("psnr", "PSNR dB", 2),
    ("ssim", "SSIM", 4),
    ("psnr_foreground", "fg PSNR dB", 2),
    ("silhouette_iou", "IoU", 3),
    ("outside_hull_mass", "outside hull", 4),
)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", nargs="*", default=[None], help="scene folders; none is the built-in scene")
    parser.add_argument("--views", nargs="+", type=int, default=[4])
    parser.add_argument("--methods", nargs="+", default=["3dgs-go", "3dgs-go+mask", "3dgs-go+vd"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--downscale", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=Path("runs/quality"))
    argv, extra = sys.argv[1:], []
    if "--" in argv:
        at = argv.index("--")
        argv, extra = argv[:at], argv[at + 1 :]
    args = parser.parse_args(argv)
    titles = ["scene", "views", "method", *(title for _, title, _ in COLUMNS), "train s", "ms a step"]
    print("| " + " | ".join(titles) + " |\n|" + " --- |" * len(titles), flush=True)
    failed = 0
    for data in args.data:
        scene = "built-in" if data is None else Path(data).name
        for views in args.views:
            for method in args.methods:
                records = []
                for seed in args.seeds:
                    folder = args.out / scene / str(views) / method / str(seed)
                    command = [f"method:{method}", "--views", str(views), "--seed", str(seed), "--quiet"]
                    command += ["--downscale", str(args.downscale), "--out", str(folder), *extra]
                    command += [] if data is None else ["--data", str(data)]
                    status = visdom_train(command)
                    if status == INTERRUPTED:
                        return status
                    if status == 0:
                        records.append(json.loads((folder / "run.json").read_text()))
                    else:
                        failed += 1
                if records:
                    print(row(scene, views, method, records), flush=True)
    return 1 if failed else 0


def row(scene: str, views: int, method: str, records: list[dict]) -> str:
    """One Markdown row: mean over seeds, and their standard deviation where there are several."""
    cells = [scene, str(views), method]
    for key, _, digits in COLUMNS:
        values = [r["metrics"]["test"][key] for r in records]
        spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
        cells.append(f"{statistics.mean(values):.{digits}f}{spread}")
    cells.append(f"{statistics.mean(r['timing']['train_s'] for r in records):.0f}")
    cells.append(f"{statistics.mean(r['timing']['step_ms'] for r in records):.0f}")
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
