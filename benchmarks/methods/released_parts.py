"""Two questions about the release's choices that no option of visdom-train asks.

    python benchmarks/methods/released_parts.py cut-off-0.25 method:3dgs-go+vd --data SCENE --method.hull.k n-1
    python benchmarks/methods/released_parts.py loss-hull method:3dgs-go+vd --data SCENE --out RUN

cut-off-SHARE: every training photograph is cropped so that it misses SHARE of the object's pixels, on its left,
right, top and bottom side in turn. Where no photograph shows all of the object, what K views see depends on K.
Test views stay whole. loss-hull: L_i goes by the release's hull of its own. All that follows is given to
visdom-train.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch

from method_configs.gs_go import RELEASED_LOSS_HULL
from visdom_plugin.cli.commands.train import main as visdom_train
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training import run as training


def crop(views: Views, share: float) -> Views:
    """The views with `share` of each mask's pixels beyond one side of the frame, and only that side cropped."""
    windows = []
    for i, mask in enumerate(views.masks):
        axis, from_end = 1 - i % 4 // 2, i % 2 == 1  # left, right, top, bottom
        along = mask.sum(1 - axis).double().cumsum(0) / mask.sum()
        size = mask.shape[axis]
        window = [(0, mask.shape[0]), (0, mask.shape[1])]
        low, high = (int((along < edge).sum()) for edge in (share, 1 - share))
        window[axis] = (0, high) if from_end else (low, size)
        windows.append(window)
    slices = [tuple(slice(*edges) for edges in window) for window in windows]
    intrinsics = views.cameras.intrinsics.clone()
    for matrix, ((top, _), (left, _)) in zip(intrinsics, windows, strict=True):
        matrix[:2, 2] -= torch.tensor([left, top]).to(matrix)
    height, width = (torch.tensor([w[axis][1] - w[axis][0] for w in windows]) for axis in (0, 1))
    cameras = Cameras(intrinsics, views.cameras.world_from_camera, width, height)
    images, masks = (
        [x[s] for x, s in zip(all_, slices, strict=True)] for all_ in (views.images, views.masks)
    )
    return replace(views, cameras=cameras, images=images, masks=masks)


def main(argv: list[str]) -> int:
    part = argv[0] if argv else ""
    if part != "loss-hull" and not part.startswith("cut-off-"):
        print(__doc__)
        return 2
    train = training.train

    def train_with_part(preset: str, config: Any, scene: Scene, **more: Any) -> Any:
        if part == "loss-hull":
            config = replace(config, vd=replace(config.vd, loss_hull=RELEASED_LOSS_HULL))
        else:
            scene = replace(scene, train=crop(scene.train, float(part.removeprefix("cut-off-"))))
        return train(preset, config, scene, **more)

    with patch.object(training, "train", train_with_part):
        return visdom_train(argv[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
