"""Scenes, their check and their hull."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from visdom_plugin.cli.commands.check import check_views
from visdom_plugin.cli.options import READING, Common, describe_reading, read_options
from visdom_plugin.cli.scenes import carving_views, open_scene
from visdom_plugin.errors import ConfigError, unknown_name
from visdom_plugin.hull.checks.findings import Finding
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training.runs.config_io import from_plain
from visdom_plugin.workflow.wording import for_callers


@for_callers
def load(data: str | Path | None = None, *, views: int = 4, downscale: float = 1, **reading: Any) -> Scene:
    """Opens a scene as the commands do.

    Args:
        data: folder of the scene, in any layout; None is the built-in scene.
        views: number of training views; a scene that has no more trains on all of them.
        downscale: >= 1, how much smaller than the photographs to work.
        reading: further options of `visdom-train` that say how a scene is read, with underscores: seed, masks,
            train_list, test_list, split, frame, colmap_model, invert_masks, missing_masks, mask_source, mask_path,
            data_format, allow_outside. Lists of views may be sequences of names and positions.

    Returns:
        Scene; its `train` and `test` are Views: cameras, images (uint8), masks (bool) and names.

    Raises:
        SceneError: for every fault of the data, and an unknown or ambiguous layout.
        ConfigError: for an unknown option, one out of range, or one that the scene cannot honour.
    """
    for name, value in reading.items():
        if name not in READING:
            raise unknown_name(f"load has no option {name!r}", name, ("data", *READING), todo="its options")
        if name in ("train_list", "test_list") and not isinstance(value, (str, Path, type(None))):
            # The comma after the last tells a list of one from the name of a file.
            reading[name] = "".join(f"{view}," for view in value)
    given = {name: str(value) if isinstance(value, Path) else value for name, value in reading.items()}
    asked = from_plain(Common(), given | {"views": views, "downscale": downscale}, "load")
    folder = None if data is None else Path(data)
    scene = open_scene(folder, **read_options(asked))
    # As run.json notes it, so that `open_run` finds the scene again, whoever trained.
    return replace(scene, source=scene.source | describe_reading(replace(asked, data=folder)))


def training_views(scene: Scene | Views, asking: str) -> Views:
    """The training views of a scene, or the views themselves.

    Raises:
        ConfigError: it is neither, such as a folder's name.
    """
    if isinstance(scene, Scene | Views):
        return scene.train if isinstance(scene, Scene) else scene
    raise ConfigError(
        f"{asking} takes a scene, and was given {scene!r:.60}",
        todo=f'open it first: {asking}(load("DIR")), or Views of your own',
    )


@for_callers
def check(scene: Scene | Views, *, k: int | None = None) -> list[Finding]:
    """What is wrong with cameras, masks and photographs of the training views, the surest first.

    Args:
        k: that you will carve with; None has the check choose.

    Returns:
        Findings, empty when nothing is wrong: `kind`, `what` in a sentence, the positions of `views`, `sure`
        ("certain", "likely" or "possible") and `todo`.

    Raises:
        SceneError: no view has a mask.
    """
    train = training_views(scene, "check")
    layout = scene.source.get("layout") if isinstance(scene, Scene) else None
    views, masks = carving_views(train)
    return list(check_views(views, masks, k=k, layout=layout).findings)


@for_callers
def carve(scene: Scene | Views, **settings: Any) -> Hull:
    """Carves the visible domain from the masks of the training views.

    Args:
        scene: or its training views.
        settings: fields of `VisibleDomain`, such as k=3, resolution=128 or max_misses=1.

    Raises:
        ConfigError: for an unknown setting, with the valid ones.
        EmptyHullError: nothing is left, with the cause where it could be established.
        SceneError: masks and cameras do not fit each other, or no view has a mask.
    """
    valid = [field.name for field in fields(VisibleDomain) if field.init]
    for name in settings:
        if name not in valid:
            raise unknown_name(f"carve has no setting {name!r}", name, valid, todo="its settings")
    views = training_views(scene, "carve")
    return VisibleDomain(**settings).carve(*views.silhouettes())
