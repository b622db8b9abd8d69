"""What views without a mask are good for: 3dgs-go(+vd) on the built-in scene with some training masks taken away.

    python benchmarks/methods/missing_masks.py [--views 6] [--without 2] [--size 100] [--steps 400] [--vd]

Prints test metrics with all masks (the reference), with the views left out, and with them as colour and as hull.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.gs_go import SPEC
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.scene import Views
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.evaluate import evaluate
from visdom_plugin.training.missing_masks import fill_masks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("views", 6), ("without", 2), ("size", 100), ("steps", 400)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--vd", action="store_true")
    given = parser.parse_args()
    whole = make_scene(SyntheticConfig(size=given.size, train_views=given.views, test_views=8))
    kept, train = list(range(given.views - given.without)), whole.train
    domain = VisibleDomain(k=min(3, len(kept)), resolution=96)
    vd = RegularizerConfig(enabled=given.vd)
    config = replace(
        SPEC.quick,
        steps=given.steps,
        hull=domain,
        vd=vd,
        mask_weight=0.1 if given.vd else SPEC.quick.mask_weight,
    )
    masks = tuple(m if i in kept else torch.ones_like(m) for i, m in enumerate(train.masks))
    origins = tuple("given" if i in kept else "missing" for i in range(given.views))
    bare = replace(whole, train=replace(train, masks=masks, mask_origins=origins))
    parts = ([getattr(train, name)[i] for i in kept] for name in ("images", "masks", "names"))
    scenes = {
        "all masks": whole,
        "left out": replace(whole, train=Views(train.cameras[kept], *parts)),
        "colour": fill_masks(bare, "colour", domain),
        "hull": fill_masks(bare, "hull", domain),
    }
    cpu = torch.device("cpu")
    for name, scene in scenes.items():
        hull = config.hull.carve(*scene.train.silhouettes())
        method = GsGo(config)
        hooks = [vd.build(hull, scene.train)] if given.vd else []
        method.setup(scene.train, hooks, hull=hull, device=cpu, seed=0)
        data = DataManager(scene.train, 0)
        for step in range(given.steps):
            output = method.train_step(data.view_batch(step), step)
            output.total.backward()
            method.optimise(step, output)
        found = evaluate(method, whole.test, reference_hull=None, device=cpu)["test"]
        shown = ", ".join(
            f"{key} {found[key]:.4g}" for key in ("psnr", "psnr_foreground", "ssim", "silhouette_iou")
        )
        print(f"{name:10s} {shown}", flush=True)


if __name__ == "__main__":
    main()
