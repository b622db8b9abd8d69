"""The contact sheet of visdom-check: every view with what its mask and the hull of the other views say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from visdom_plugin.hull.carve import carve_silhouettes
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.raycast import depth_and_silhouette
from visdom_plugin.hull.votes import gather_silhouettes

if TYPE_CHECKING:
    from visdom_plugin.hull.check import Check
    from visdom_plugin.scene import Views

_CELL = 300
_LABEL = 40
_MASK, _HULL, _WRONG, _ROOM = (255, 214, 0), (0, 200, 255), (255, 40, 40), (60, 110, 255)
_RESOLUTION = 96


def draw_check(views: Views, masks: Sequence, found: Check) -> np.ndarray:
    """The sheet, (H, W, 3) uint8 RGB.

    Yellow outlines the mask and cyan the hull of the other usable views. Red is foreground that no point of that
    hull explains; blue tints room the view takes away from it.
    """
    hulls = _hulls_of_others(views, masks, found)
    columns = min(len(views), max(2, math.ceil(math.sqrt(1.5 * len(views)))))
    named = {}
    for f in (*found.findings, *found.notes):
        for view in f.views:
            named.setdefault(view, []).append(f"{f.kind} ({'note' if f.note else f.sure})")
    cells = []
    for view in range(len(views)):
        picture = _draw_view(np.asarray(views.images[view]), np.asarray(masks[view]), hulls.get(view))
        cells.append((picture, str(views.names[view]), ", ".join(named.get(view, []))))
    tall = max(c[0].shape[0] for c in cells) + _LABEL
    rows = -(-len(cells) // columns)
    top = 26 + 18 * min(len(found.findings), 8)
    sheet = np.full((top + rows * tall, columns * (_CELL + 6) + 6, 3), 24, np.uint8)
    for at, f in enumerate(found.findings[:8]):
        _write(sheet, f"{f.sure}: {f.what}", 8, 18 + 18 * at, (255, 255, 255))
    if not found.findings:
        _write(sheet, "nothing wrong", 8, 18, (120, 255, 120))
    for k, (picture, name, text) in enumerate(cells):
        y, x = top + k // columns * tall, 6 + k % columns * (_CELL + 6)
        sheet[y : y + picture.shape[0], x : x + _CELL] = picture
        _write(sheet, name, x + 2, y + picture.shape[0] + 14, (230, 230, 230))
        _write(sheet, text, x + 2, y + picture.shape[0] + 30, _WRONG if text else (230, 230, 230))
    return sheet


def _hulls_of_others(views: Views, masks: Sequence, found: Check) -> dict[int, np.ndarray]:
    """Silhouettes, at the cells' size, of the hull of all usable views but the one."""
    usable = list(found.usable)
    if len(usable) < 2:
        return {}
    index = torch.tensor(usable)
    cameras = views.cameras[index]
    domain = VisibleDomain(resolution=_RESOLUTION, k=1, components="largest")
    k = 3 if found.advice is None else found.advice.k
    result = {}
    for view in range(len(views)):
        if np.asarray(masks[view]).shape != (int(views.cameras.height[view]), int(views.cameras.width[view])):
            continue
        others = [i for i, v in enumerate(usable) if v != view]
        rest = cameras[torch.tensor(others)]
        wide = torch.full_like(rest.width, _CELL)
        small = rest.resized(wide, (rest.height * _CELL / rest.width).round().clamp_min(1).long())
        shrunk = [_shrink(np.asarray(masks[usable[i]]), small[k]) for k, i in enumerate(others)]
        rule = replace(domain, k=max(1, min(k, len(others))))
        hull = carve_silhouettes(rule, small, gather_silhouettes(small, shrunk))
        camera = views.cameras[view]
        height = max(1, round(int(camera.height) * _CELL / int(camera.width)))
        if hull is None:
            result[view] = np.zeros((height, _CELL), bool)
        else:
            result[view] = depth_and_silhouette(hull, camera.resized(_CELL, height))[1].numpy()
    return result


def _shrink(mask: np.ndarray, camera) -> np.ndarray:
    size = int(camera.width), int(camera.height)
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)


def _draw_view(image: np.ndarray, mask: np.ndarray, hull: np.ndarray | None) -> np.ndarray:
    height = max(1, round(image.shape[0] * _CELL / image.shape[1]))
    way = cv2.INTER_AREA if image.shape[1] > _CELL else cv2.INTER_LINEAR
    picture = cv2.resize(np.ascontiguousarray(image), (_CELL, height), interpolation=way).astype(np.float32)
    mask = cv2.resize(mask.astype(np.uint8), (_CELL, height), interpolation=cv2.INTER_NEAREST) > 0
    picture *= np.where(mask, 1.0, 0.55)[..., None]
    if hull is not None and hull.shape == mask.shape:
        # The hull's voxels are about two pixels of a cell: its edge is not known better.
        missed = mask & ~cv2.dilate(hull.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        room = hull & ~mask
        picture[missed] = 0.35 * picture[missed] + 0.65 * np.array(_WRONG)
        picture[room] = 0.75 * picture[room] + 0.25 * np.array(_ROOM)
    picture = picture.clip(0, 255).astype(np.uint8)
    for outline, colour in ((hull, _HULL), (mask, _MASK)):
        if outline is not None and outline.shape == mask.shape:
            lines, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, lines, -1, colour, 1, cv2.LINE_AA)
    return picture


def _write(sheet: np.ndarray, text: str, x: int, y: int, colour) -> None:
    shown = text.encode("ascii", "replace").decode()
    cv2.putText(sheet, shown, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
