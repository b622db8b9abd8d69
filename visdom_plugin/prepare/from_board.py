"""Cameras from the printed board in the photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datamodules.files.undistort import Distortion
from datamodules.views.reader import map_on_cores
from visdom_plugin.compute.waiting import counting, phase
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.prepare.board import Corners, corner_points, find_corners, other_boards
from visdom_plugin.prepare.calibrate import calibrate
from visdom_plugin.prepare.photographs import FULL_FRAME_MM, Photograph, require_one_camera
from visdom_plugin.prepare.placed import Placed, make_cameras
from visdom_plugin.prepare.settings import BoardSettings

_FEW = 6
_LOOKED_AT = 4
"""Photographs in which other boards are looked for."""


def place_by_board(
    photographs: Sequence[Photograph], settings: BoardSettings, focal_35mm: float | None = None
) -> Placed:
    """Finds the board in every photograph and places their cameras.

    Args:
        focal_35mm: focal length as the 35 mm equivalent, in place of EXIF's.

    Raises:
        SceneError: no board, another board, too few views of it, or photographs of several cameras.
    """
    if len(photographs) < 2:
        raise SceneError(
            "there is one photograph, which does not tell where its camera was and what lens it has",
            where=photographs[0].path,
            todo="take six or more, from all round the object",
            topic="no-board",
        )
    require_one_camera(photographs)
    every = range(len(photographs))
    with counting("looking for the board in the photographs", len(photographs)) as count:
        found = map_on_cores(lambda i: count(find_corners(_grey(photographs[i]), settings)), every)
    if not any(len(c.ids) for c in found):
        _refuse(photographs, found, settings)
    sizes = [p.size for p in photographs]
    names = [p.name for p in photographs]
    if focal_35mm is not None:
        focal: float | None = focal_35mm / FULL_FRAME_MM * float(np.hypot(*sizes[0]))
    else:
        focals = [p.focal_px for p in photographs if p.focal_px]
        focal = float(np.median(focals)) if focals else None
    with phase("placing the cameras"):
        result = calibrate(found, corner_points(settings), sizes, names, focal)
    placed = [i for i, view in enumerate(result.views) if view.world_from_camera is not None]
    K = np.zeros((len(placed), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = result.focal_px
    K[:, :2, 2] = np.array(sizes)[placed] / 2
    K[:, 2, 2] = 1
    cameras = make_cameras(K, [v for i in placed if (v := result.views[i].world_from_camera) is not None],
                           [sizes[i] for i in placed])  # fmt: skip
    bent = Distortion("RADIAL", result.radial) if any(result.radial) else None
    return Placed(
        [photographs[i] for i in placed],
        cameras,
        [bent] * len(placed),
        "the printed board",
        "metres",
        True,
        {v.name: v.reason for v in result.views if v.world_from_camera is None},
        {v.name: {"corners": v.corners, "reprojection_px": v.rms_px} for v in result.views},
        {
            "focal_px": result.focal_px,
            "focal_start_px": focal,
            "focal_sigma": result.focal_sigma,
            "k1": result.radial[0],
            "k2": result.radial[1],
            "reprojection_px": result.rms_px,
        },
        result.notes,
    )


def _grey(photograph: Photograph) -> np.ndarray:
    import cv2

    return cv2.cvtColor(photograph.decode(), cv2.COLOR_RGB2GRAY)


def _refuse(photographs: Sequence[Photograph], found: Sequence[Corners], settings: BoardSettings) -> None:
    """Raises the error for photographs none of which shows a corner of the board."""
    others: list[str] = []
    for photograph in photographs[:_LOOKED_AT]:
        others = others or other_boards(_grey(photograph), settings)
    markers = max(c.markers for c in found)
    columns, rows = settings.squares
    board = f"{columns} x {rows} squares, markers {settings.dictionary.upper()}"
    if others:
        cause, todo = f"the photographs show markers of {others[0]}", f"pass --dictionary {others[0]}"
        todo += ", and --squares, --square-mm and --marker-mm of that board"
    elif 0 < markers < _FEW:
        cause = f"{markers} of its markers can be read at most: it is covered, blurred or too small"
        todo = "show more of the board, sharper and larger; the object may be beside it"
    elif markers:
        cause = f"{markers} of its markers were read, but not where such a board has them"
        todo = "give the board's own --squares; try --legacy for one made by OpenCV before 4.6"
    else:
        cause = "the photographs show no board, or it is too small, too blurred or behind the object"
        todo = "print the board (visdom-prepare --print-board board.pdf) and lay it under the object; or pass the "
        todo += "poses of another program: --poses FILE"
    raise SceneError(
        f"no board ({board}) was found in any of {len(photographs)} photographs",
        where=f"{photographs[0].path.parent}: {list_some(p.name for p in photographs)}",
        cause=cause,
        todo=todo,
        topic="no-board",
    )
