"""Folders with a COLMAP model in general, and what all layouts with such a model share.

sparse/<n>, sparse, colmap/sparse/<n>, dense/sparse, sparse_<N>/<n> or the folder itself
                                        the model, text or binary; of several, the one with most photographs
images/ or images_<F>/                  photographs, F times smaller in the latter
masks/                                  foreground masks, named after the photographs; or alpha channels
depths/                                 optional monocular depth, named after the photographs: .npy (H, W) in any
                                        unit, or 16-bit PNG of depth times 1000

Every 8th view by name is for testing and training views are spread evenly over the others, unless index files
or lists say otherwise.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from datamodules.capture import Calibration, Capture, Frame, sort_frames
from datamodules.files import colmap_model
from datamodules.files.colmap_points import find_points
from datamodules.files.find_model import choose_model, find_model
from datamodules.files.paths import check_name, stem
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.find_files import ImageFiles, localise, note_localised
from visdom_plugin.errors import SceneError

log = logging.getLogger(__name__)


def recognise(root: Path) -> str | None:
    """What makes the folder look like this layout, or None."""
    folder = find_model(root)
    # Programs that write transforms.json leave the model it was made from in these places.
    if folder in ("colmap/sparse/0", "colmap_sparse/0") and (root / "transforms.json").exists():
        return None
    return None if folder is None else f"a COLMAP model in {folder or 'the folder itself'}"


def read(root: Path, request: Request) -> Capture:
    """Reads the model; every 8th view is for testing.

    Raises:
        SceneError: there is no readable model.
    """
    return read_capture(root, request, "colmap")


def read_capture(
    root: Path,
    request: Request,
    layout: str,
    *,
    folder: str | None = None,
    indexed: bool = False,
    mask_folder: str = "masks",
    depths: str | None = None,
    notes: Sequence[str] = (),
) -> Capture:
    """A capture of a COLMAP model and a folder `images`.

    Args:
        folder: of the model below the root, for layouts that have one place for it; None looks in the usual
            places and takes the model with most photographs.
        indexed: whether index files are demanded.
        depths: folder of monocular depth maps that a layout has in place of `depths`.
    """
    chosen, said = choose_model(root, request.colmap_model)
    folder = chosen if folder is None or request.colmap_model else folder
    if folder is None:
        raise SceneError(
            "there is no COLMAP model in this folder",
            where=root,
            todo="put cameras.bin and images.bin (or the .txt pair) into sparse/0",
            topic="no-scene",
        )
    if folder != chosen:
        said = [f"{folder} is read, which the index files were made for, not {chosen}"] if chosen else []
    for line in said:
        log.log(logging.INFO if folder == find_model(root) else logging.WARNING, "%s: %s", root, line)
    model = colmap_model.read_model(root, folder, outside=request.allow_outside)
    points = find_points(root, folder)
    there, names = ImageFiles(root), [image.name for image in model.images]
    if not request.allow_outside:
        found = [localise(there, name) for name in names]
        said += note_localised(names, found)
        names = [
            new.removeprefix("images/") if new != old else new for new, old in zip(found, names, strict=True)
        ]
    for name in names:
        check_name(name, model.folder, outside=request.allow_outside)
    registered = dict(zip(names, model.images, strict=True))
    maps = next((f for f in (depths, "depths") if f is not None and (root / f).is_dir()), None)
    frames = sort_frames(
        [
            Frame(name, f"images/{name}", depth=None if maps is None else _depth_file(root, maps, stem(name)))
            for name in names
        ]
    )

    def calibrate(wanted: Sequence[int]) -> Calibration:
        return Calibration(*colmap_model.cameras_of(model, [registered[frames[i].name] for i in wanted]))

    return Capture(
        root,
        layout,
        frames,
        calibrate,
        splits.every_eighth(range(len(frames))),
        (*model.files, points) if points else model.files,
        indexed=indexed,
        photographs="images",
        mask_folder=mask_folder,
        points_file=points,
        honours=("colmap_model",),
        notes=(*notes, *said),
    )


def _depth_file(root: Path, folder: str, view: str) -> str:
    """Where a view's depth map lies, below the root, if there is one.

    Raises:
        SceneError: there are two.
    """
    array, picture = (f"{folder}/{view}{ending}" for ending in (".npy", ".png"))
    if not (root / array).is_file():
        return picture
    if (root / picture).is_file():
        raise SceneError(
            f"there are two depth maps of one view, {array} and {picture}",
            where=root,
            todo="take one of them away; a preview in colours belongs into another folder",
            topic="depth",
        )
    return array
