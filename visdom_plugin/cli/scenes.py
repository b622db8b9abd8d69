"""Scenes as commands ask for them, and batches of their views for the trainer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from visdom_plugin.compute.waiting import phase
from visdom_plugin.scene import Scene, Views

if TYPE_CHECKING:
    import torch

    from visdom_plugin.training.batches import DataManager
    from visdom_plugin.training.missing_masks import Way


def make_data_manager(views: Views, seed: int, device: torch.device) -> DataManager:
    """Batches of the training views on a device."""
    from visdom_plugin.training.batches import DataManager

    return DataManager(views, seed, device=device)


@phase("reading the scene")
def open_scene(
    path: Path | None,
    *,
    views: int,
    downscale: float,
    seed: int,
    missing_masks: Way = "error",
    fill: bool = True,
    **reading: Any,
) -> Scene:
    """A scene as a command asks for it.

    Args:
        missing_masks: what becomes of views without a mask, see `training.missing_masks`.
        fill: False leaves views without a mask as they are, for who only carves.
        reading: other options of `datamodules.load`.

    Raises:
        SceneError: for every fault of the data.
    """
    from datamodules import load
    from visdom_plugin.training.missing_masks import fill_masks

    scene = load(
        path,
        views=views,
        downscale=downscale,
        seed=seed,
        **load_options(missing_masks=missing_masks, **reading),
    )
    return fill_masks(scene, missing_masks) if fill else scene


def load_options(*, missing_masks: str = "error", **reading: Any) -> dict[str, Any]:
    """Options of a command on how a scene is read, as `datamodules.load` takes them."""
    return reading if missing_masks == "error" else reading | {"allow_missing_masks": True}


def carving_views(views: Views) -> tuple[Views, list]:
    """The views whose masks were given, and these masks: True on what is known to be object."""
    given = [i for i in range(len(views)) if views.mask_origin(i) == "given"]
    cameras, masks, ignore = views.silhouettes()
    images = [views.images[i] for i in given]
    names = [views.names[i] for i in given]
    chosen = Views(cameras, images, masks, names, ignore=ignore)
    return chosen, [chosen.demanded(i) for i in range(len(chosen))]
