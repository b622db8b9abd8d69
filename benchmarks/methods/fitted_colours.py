"""PSNR of runs' test views as they are, and after each render's colours were fitted to its photograph.

An affine map from rgb to rgb is fitted over the mask, by least squares: what is left is no difference in exposure
or white balance between the photographs.

    python benchmarks/methods/fitted_colours.py RUN [RUN ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from visdom_plugin.cli.runs import load_again
from visdom_plugin.figures.contact_sheet import picture_names, read_png
from visdom_plugin.training.metrics import psnr, psnr_foreground, whiten
from visdom_plugin.training.runs.run_directory import read_record


def measure(run: Path) -> tuple[float, float]:
    """Means over the test views of PSNR and PSNR inside the mask, dB, with fitted colours."""
    scene = load_again(read_record(run), run, None)
    rows = []
    for i, name in enumerate(picture_names(scene.test.names)):
        drawn = torch.from_numpy(read_png(run / "renders" / "test" / f"{name}.png")).double() / 255
        mask = scene.test.masks[i]
        truth = whiten(scene.test.images[i], mask)
        own = torch.cat([drawn[mask], torch.ones(int(mask.sum()), 1, dtype=torch.float64)], 1)
        drawn[mask] = (own @ torch.linalg.lstsq(own, truth[mask]).solution).clamp(0, 1)
        rows.append((psnr(drawn, truth), psnr_foreground(drawn, truth, mask)))
    whole, inside = torch.tensor(rows).mean(0).tolist()
    return whole, inside


def main() -> None:
    print("run: PSNR, inside the mask; with fitted colours")
    for run in map(Path, sys.argv[1:]):
        plain = read_record(run)["metrics"]["test"]
        whole, inside = measure(run)
        own = f"{plain['psnr']:.2f}, {plain['psnr_foreground']:.2f}"
        print(f"{run}: {own}; {whole:.2f}, {inside:.2f}")


if __name__ == "__main__":
    main()
