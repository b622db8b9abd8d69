"""What better shapes could be worth: visdom-gs with a shape that no training view tells.

    python benchmarks/methods/oracle_shape.py silhouettes --data SCENE --downscale 4 --views 6 --out runs/oracle
    python benchmarks/methods/oracle_shape.py surface --views 6 --out runs/oracle_surface

silhouettes: the hull of all masks, test views included, is hull and shape. surface: the true mesh, filled, is the
shape; the hull is the training views'. All that follows is given to visdom-train method:visdom-gs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from visdom_plugin.cli.commands.train import main as visdom_train
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.surface_distance import fill_mesh
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training import run as training


def from_all_silhouettes(config: Any, scene: Scene) -> Hull:
    """The hull of the masks of training and test views, as its own shape inside."""
    views = scene.train, scene.test
    cameras = Cameras.stack([camera for v in views for camera in v.cameras])
    masks = [mask for v in views for mask in v.masks]
    ignore = [v.ignored(i) for v in views for i in range(len(v))]
    hull: Hull = config.hull.carve(cameras, masks, ignore)
    return replace(hull, inner=hull)


def from_surface(config: Any, scene: Scene) -> Hull:
    """The training views' hull, with the filled mesh of the scene as its shape inside."""
    if scene.mesh is None:
        sys.exit("this scene has no mesh: take the built-in one, without --data")
    hull: Hull = config.hull.carve(*scene.train.silhouettes())
    vertices, faces = (x.numpy() for x in scene.mesh)
    filled = fill_mesh(vertices, faces, hull.bounds, hull.shape)
    return replace(hull, inner=Hull(filled, hull.bounds, hull.summary))


ORACLES: dict[str, Callable[[Any, Scene], Hull]] = {
    "silhouettes": from_all_silhouettes,
    "surface": from_surface,
}


def main(argv: list[str]) -> int:
    if not argv or argv[0] not in ORACLES:
        print(__doc__)
        return 2
    oracle, train = ORACLES[argv[0]], training.train

    def train_with_oracle(preset: str, config: Any, scene: Scene, **more: Any) -> Any:
        def find(config: Any, _: Views, __: Path | None) -> Hull:
            return oracle(config, scene)

        with patch.object(training, "find_hull", find):
            return train(preset, config, scene, **more)

    with patch.object(training, "train", train_with_oracle):
        return visdom_train(["method:visdom-gs", *argv[1:]])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
