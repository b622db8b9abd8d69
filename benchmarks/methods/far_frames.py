"""Quality in frames far from the origin: python benchmarks/methods/far_frames.py ingp+vd 3dgs-go+vd

The built-in scene is shifted, as coordinates of a survey would be, and each method trains its `quick`
preset there. The PSNR of the test views should not depend on the shift beyond the rounding of the poses
themselves.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from datamodules import load
from visdom_plugin import registry
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import train

SHIFTS = (0.0, 1e5, 5e6)
"""In units of the scene, whose object is about 2 long; split over the axes as 1, -0.7, 0.3."""


def main() -> None:
    torch.set_num_threads(1)
    scene = load(None, views=4, seed=0)
    print("| method | " + " | ".join(f"{shift:g}" for shift in SHIFTS) + " |")
    print("| --- |" + " --- |" * len(SHIFTS))
    for name in sys.argv[1:] or ["ingp+vd", "3dgs-go+vd"]:
        cells = []
        for shift in SHIFTS:
            origin = -shift * torch.tensor([1, -0.7, 0.3], dtype=torch.float64)
            parts = {
                part: replace(views, cameras=views.cameras.relative_to(origin))
                for part, views in (("train", scene.train), ("test", scene.test))
            }
            with tempfile.TemporaryDirectory() as folder:
                record = train(
                    name,
                    registry.find(name).quick,
                    replace(scene, **parts),
                    data_manager=DataManager,
                    run_dir=Path(folder) / "run",
                    quiet=True,
                )
            cells.append(f"{record['metrics']['test']['psnr']:.3f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
