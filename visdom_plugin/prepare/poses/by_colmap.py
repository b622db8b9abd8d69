"""Poses by COLMAP itself, through pycolmap: features, matches of all pairs, a map of what fits together."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.views.reader import map_on_cores
from visdom_plugin.compute.waiting import counting, phase
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.prepare.photographs import Photograph, require_one_camera
from visdom_plugin.prepare.placed import Placed
from visdom_plugin.prepare.poses.find import place_by_file

log = logging.getLogger(__name__)

USUAL_VIEWS = 10
"""COLMAP rarely registers all of fewer photographs."""
_COPY_PX = 1600
_FOCAL_GUESS = 1.2
"""In longer sides of the image, where EXIF says nothing: COLMAP's own guess."""


def place_by_colmap(photographs: Sequence[Photograph]) -> Placed:
    """Runs COLMAP on small copies of the photographs, one camera for all.

    Raises:
        ConfigError: pycolmap is not installed.
        SceneError: photographs of several cameras, or COLMAP finds no map of two photographs or more.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise ConfigError(
            "pycolmap is not installed",
            where="--colmap",
            todo="pip install 'visdom-plugin[colmap]', or run COLMAP yourself and pass --poses MODEL",
            topic="not-installed",
        ) from error
    require_one_camera(photographs)
    few = len(photographs) < USUAL_VIEWS
    if few:
        log.warning(
            "COLMAP rarely registers fewer than %d photographs; there are %d. A printed board places any number",
            USUAL_VIEWS,
            len(photographs),
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        (folder / "sparse").mkdir()
        every = range(len(photographs))
        with counting("copying photographs for COLMAP", len(photographs)) as count_copy:
            focal = map_on_cores(lambda i: count_copy(_copy(photographs[i], folder / "images")), every)[0]
        count = _map(pycolmap, folder, focal)
        if count < 2:
            raise SceneError(
                f"COLMAP registers {count} of {len(photographs)} photographs",
                where=photographs[0].path.parent,
                cause="photographs that are too far apart or too few, or an object without texture",
                todo="lay the printed board under the object (--print-board), or take 20 to 50 that overlap",
            )
        placed = place_by_file(folder / "sparse", photographs)
    notes = [n for n in placed.notes if str(folder) not in n]
    left = dict.fromkeys(placed.left_out, "COLMAP did not register it")
    return replace(placed, source="COLMAP", left_out=left, notes=notes)


def _copy(photograph: Photograph, folder: Path) -> tuple[float, float, float]:
    """Writes a small copy as stored, without tags; returns focal length and principal point in its pixels."""
    from PIL import Image

    image = Image.fromarray(photograph.decode())
    scale = min(1.0, _COPY_PX / max(image.size))
    size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
    image.resize(size, Image.Resampling.BOX).save(folder / f"{photograph.path.stem}.png", compress_level=1)
    focal = photograph.focal_px * scale if photograph.focal_px else _FOCAL_GUESS * max(size)
    return focal, size[0] / 2, size[1] / 2


def _map(pycolmap: Any, folder: Path, lens: tuple[float, float, float]) -> int:
    """Writes the largest map into `folder/sparse`; returns how many photographs it has."""
    pycolmap.logging.minloglevel = 2  # its own log speaks of every step
    database, images = folder / "database.db", folder / "images"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "RADIAL"
    reader.camera_params = ",".join(map(str, (*np.array(lens).tolist(), 0.0, 0.0)))
    single = pycolmap.CameraMode.SINGLE
    with phase("COLMAP, 1 of 3: features"):
        pycolmap.extract_features(database, images, camera_mode=single, reader_options=reader)
    with phase("COLMAP, 2 of 3: matches"):
        pycolmap.match_exhaustive(database)
    with phase("COLMAP, 3 of 3: the map"):
        maps = pycolmap.incremental_mapping(database, images, folder / "maps")
    if not maps:
        return 0
    best = max(maps.values(), key=lambda found: found.num_reg_images())
    best.write(folder / "sparse")
    return int(best.num_reg_images())
