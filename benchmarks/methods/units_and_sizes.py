"""Quality in other units and at other sizes: python benchmarks/methods/units_and_sizes.py 3dgs-go+vd ingp+vd

The built-in scene has its positions multiplied, or its photographs rendered smaller and larger, and each
method trains its `quick` preset there. The PSNR should not depend on the unit but for rounding. At each size
the test views are as large as the training views, which is what a user sees; averaged down to 100 pixels,
more pixels should never make them worse.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import registry
from visdom_plugin.figures.contact_sheet import picture_names, read_png
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.metrics import psnr, whiten
from visdom_plugin.training.run import train

UNITS = (1.0, 0.002, 1000.0)
"""Factors of all positions."""
SIZES = (100, 200, 400)
"""Widths and heights of the training photographs."""


def main() -> None:
    torch.set_num_threads(1)
    scenes = {size: make_scene(SyntheticConfig(size=size)) for size in SIZES}
    columns = {f"unit x {s:g}": scaled(scenes[200], s) for s in UNITS}
    columns |= {f"{size} px": scenes[size] for size in SIZES}
    truth = shrunk(
        [whiten(*pair) for pair in zip(scenes[400].test.images, scenes[400].test.masks, strict=True)]
    )
    print("| method | " + " | ".join(columns) + " |")
    print("| --- |" + " --- |" * len(columns))
    for name in sys.argv[1:] or ["ingp+vd", "3dgs-go+vd"]:
        cells = [measure(name, scene, truth) for scene in columns.values()]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def scaled(scene: Scene, s: float) -> Scene:
    """The scene with all positions times `s`."""

    def of(views: Views) -> Views:
        return replace(views, cameras=views.cameras.in_units(1 / s))

    return replace(scene, train=of(scene.train), test=of(scene.test))


def shrunk(pictures: Sequence[Tensor]) -> Tensor:
    """Pictures (H, W, 3) averaged down to the smallest size, (N, 100, 100, 3)."""
    stack = torch.stack([picture.double() for picture in pictures]).permute(0, 3, 1, 2)
    return torch.nn.functional.interpolate(stack, size=SIZES[0], mode="area").permute(0, 2, 3, 1)


def measure(name: str, scene: Scene, truth: Tensor) -> str:
    """PSNR of the test views as drawn and averaged down, and the number of Gaussians where there are any."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        record = train(
            name,
            registry.find(name).quick,
            scene,
            data_manager=DataManager,
            run_dir=run,
            quiet=True,
        )
        files = picture_names(scene.test.names)
        drawn = [torch.from_numpy(read_png(run / "renders" / "test" / f"{file}.png")) / 255 for file in files]
    small = shrunk(drawn)
    averaged = sum(psnr(x, y) for x, y in zip(small, truth, strict=True)) / len(truth)
    counts = "".join(f", {count} {what}" for what, count in record["model"].items())
    found = f"{record['metrics']['test']['psnr']:.2f}, {averaged:.2f}{counts}"
    print(f"{name} at {scene.train.images[0].shape[1]} px: {found}", file=sys.stderr, flush=True)
    return found


if __name__ == "__main__":
    main()
