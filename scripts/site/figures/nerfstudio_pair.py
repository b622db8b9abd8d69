"""The picture of docs/nerfstudio.md: unseen views of the first built-in scene by nerfacto and nerfacto-vd.

In an environment of scripts/nerfstudio_env.sh:

python benchmarks/methods/nerfstudio_pair.py --downscale 2 --methods nerfacto nerfacto-vd --out RUNS
python scripts/site/figures/nerfstudio_pair.py RUNS
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from before_after import PICTURES, draw, on_white, write_webp

from datamodules import load

MAKES = ("nerfstudio_pair.webp",)
VIEWS = (4, 11)
"""Test views that are shown."""
METHODS = {"nerfacto": "nerfacto/nerfacto-0", "nerfacto-vd": "nerfacto-vd/nerfacto-vd-0"}


def main() -> None:
    """Draws the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    args = parser.parse_args()
    scene = load(None, views=4, downscale=2)
    columns = [("truth", [on_white(scene.test, i) for i in VIEWS])]
    for method, place in METHODS.items():
        run = args.runs / "built-in" / place
        psnr = json.loads((run / "eval.json").read_text(encoding="utf-8"))["results"]["psnr"]
        columns.append((f"{method}\n{psnr:.1f} dB", [render_of(run / "views", i) for i in VIEWS]))
    photographs = [on_white(scene.train, i) for i in range(len(scene.train))]
    write_webp(draw(photographs, columns), PICTURES / MAKES[0], 80)


def render_of(folder: Path, index: int) -> np.ndarray:
    """(H, W, 3) RGB: the right half of what ns-eval writes, of which the left is the photograph."""
    picture = cv2.imread(str(folder / f"eval_img_{index:04d}.png"))[..., ::-1]
    return picture[:, picture.shape[1] // 2 :]


if __name__ == "__main__":
    main()
