"""One sheet of test views, a row per finished run and the truth on top.

    cd runs/quality/built-in/4
    python ../../../../benchmarks/methods/compare_pictures.py --out s.webp 3dgs-go/0 3dgs-go+mask/0 3dgs-go+vd/0

The runs must be of one scene; the truth is loaded as the first run's was.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from datamodules import load
from visdom_plugin.cli.entry import run
from visdom_plugin.errors import ConfigError
from visdom_plugin.figures.contact_sheet import draw_sheet, picture_names, to_bytes
from visdom_plugin.training.metrics import whiten
from visdom_plugin.training.runs.run_directory import read_record


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=5, help="test views shown, evenly spaced")
    args = parser.parse_args(argv)
    sheet = np.ascontiguousarray(draw_runs(args.runs, args.count)[..., ::-1])
    cv2.imwrite(str(args.out), sheet, [cv2.IMWRITE_WEBP_QUALITY, 85])


def draw_runs(runs: Sequence[Path], count: int) -> np.ndarray:
    """(H, W, 3) uint8: `count` test views, evenly spaced, of finished runs of one scene, below the truth."""
    records = [read_record(path) for path in runs]
    data = records[0]["data"]
    if any(record["data"]["test"] != data["test"] for record in records):
        raise ConfigError("the runs have different test views", todo="name runs of one scene")
    scene = load(data["path"], views=data["views"], downscale=data["downscale"], seed=data.get("seed", 0))
    names = picture_names(scene.test.names)
    columns = []
    for i in np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int):
        pictures = [to_bytes(whiten(scene.test.images[i], scene.test.masks[i]))]
        for path in runs:
            image = cv2.imread(str(path / "renders" / "test" / f"{names[i]}.png"))
            if image is None:
                raise ConfigError(f"{path} has no picture of {names[i]}", todo="run visdom-eval on it")
            pictures.append(image[..., ::-1])
        columns.append((names[i], pictures))
    rows = ["truth", *(record["method"] for record in records)]
    return draw_sheet(columns, rows)


if __name__ == "__main__":
    sys.exit(run(main))
