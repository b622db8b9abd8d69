"""The mask of each view: the one that is there, or one that is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.prepare.masks.make import cut_views
from visdom_plugin.prepare.masks.volume import board_volume, given_volume
from visdom_plugin.prepare.settings import BoardSettings, MaskSettings
from visdom_plugin.scene import NO_MASKS

Masks = list[np.ndarray | None]


def choose_masks(
    settings: MaskSettings,
    cameras: Cameras,
    images: Sequence[np.ndarray],
    given: Sequence[np.ndarray | None],
    names: Sequence[str],
    *,
    board: BoardSettings | None,
    where: Path,
) -> tuple[Masks, list[str]]:
    """Masks N x (H, W) bool, None where there is none, and how each was made.

    Args:
        cameras: (N,) of the images.
        images: N x (H, W, 3) uint8.
        given: the masks that the photographs have.
        board: the board that the object stands on; None where poses are from elsewhere.

    Raises:
        SceneError: masks are missing, or cannot be made.
        ConfigError: settings that contradict each other.
    """
    ways = ["given" if mask is not None else "none" for mask in given]
    missing = [i for i, mask in enumerate(given) if mask is None]
    if settings.source == "none" or (settings.source in ("auto", "given") and not missing):
        return list(given), ways
    if settings.source == "given":
        raise SceneError(
            f"{len(missing)} of {len(given)} photographs have no mask: {list_some(names[i] for i in missing)}",
            where=where,
            todo=NO_MASKS,
            topic="mask-missing",
        )
    if settings.source == "rembg":
        from visdom_plugin.prepare.masks.rembg import cut_with_rembg

        made, way = cut_with_rembg(images, names, settings.models, settings.model), "rembg"
    else:
        made, way = (
            cut_views(
                cameras,
                images,
                names,
                _find_box(settings, board, where),
                plane=board is not None,
                rounds=settings.rounds,
            ),
            "grabcut",
        )
    empty = [names[i] for i, mask in enumerate(made) if not mask.any()]
    if empty:
        raise SceneError(
            f"no object was found in {list_some(empty)}",
            where=where,
            cause="it has the colours of its background, or lies outside the box that is looked at"
            if way == "grabcut"
            else "the network sees nothing there that stands out",
            todo="say where it is: --box, or --height; leave the photographs out; or give masks: --masks DIR",
            topic="no-object",
        )
    kept = [made[i] if mask is None else mask for i, mask in enumerate(given)]
    return list(kept), [way if mask is None else "given" for mask in given]


def _find_box(settings: MaskSettings, board: BoardSettings | None, where: Path) -> np.ndarray:
    if settings.box is not None:
        return given_volume(settings.box)
    if board is not None:
        return board_volume(board.size_m, settings.height)
    raise SceneError(
        "the photographs have no masks, and without a board nothing says where the object is",
        where=where,
        cause="poses of another program know no object",
        todo="give masks (--masks DIR), a box in scene units (--box X0 Y0 Z0 X1 Y1 Z1), or networks "
        "(--mask-source rembg); or leave masks to later: --mask-source none",
        topic="mask-missing",
    )
