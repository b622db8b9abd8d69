"""The contact sheet of visdom-check: every view with what its mask and the hull of the other views say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from textwrap import wrap
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from visdom_plugin.figures.canvas import Canvas
from visdom_plugin.hull.carving.carve import carve_silhouettes
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.outlines.distance_fields import draw_outlines, is_known
from visdom_plugin.hull.outlines.silhouette_consistency import TOLERANCE_PX, march_rays
from visdom_plugin.hull.queries.raycast import depth_and_silhouette

if TYPE_CHECKING:
    from torch import Tensor

    from visdom_plugin.geometry.cameras import Cameras
    from visdom_plugin.hull.checks.check import Check
    from visdom_plugin.scene import Views

_CELL = 300
_LABEL = 40
_LINES = 16
_MASK, _HULL, _WRONG, _ROOM = (255, 214, 0), (0, 200, 255), (255, 40, 40), (60, 110, 255)
_LEGEND = (
    ("mask", _MASK),
    ("hull of the other views", _HULL),
    ("ruled out by other masks", _WRONG),
    ("room this view removes", _ROOM),
)
_LEGEND_WIDTH = 8 + sum(7 * len(text) + 16 for text, _ in _LEGEND)
_RESOLUTION = 96


def draw_check(views: Views, masks: Sequence[Tensor | np.ndarray], found: Check) -> np.ndarray:
    """The sheet, (H, W, 3) uint8 RGB.

    Yellow outlines the mask and cyan the hull of the other usable views. Red is foreground whose rays the other
    masks rule out; blue tints room that the view takes away from the hull of the others.
    """
    masks = [np.asarray(m) for m in masks]
    hulls, wrong = _hulls_of_others(views, masks, found), _contradicted(views, masks, found)
    columns = min(len(views), max(2, math.ceil(math.sqrt(1.5 * len(views)))))
    named: dict[int, list[str]] = {}
    for f in (*found.findings, *found.notes):
        for view in f.views:
            named.setdefault(view, []).append(f"{f.kind} ({'note' if f.note else f.sure})")
    cells = []
    for view in range(len(views)):
        picture = _draw_view(
            np.asarray(views.images[view]), np.asarray(masks[view]), hulls.get(view), wrong.get(view)
        )
        cells.append((picture, str(views.names[view]), ", ".join(named.get(view, []))))
    tall = max(c[0].shape[0] for c in cells) + _LABEL
    rows = -(-len(cells) // columns)
    wide = max(columns * (_CELL + 6) + 6, _LEGEND_WIDTH)
    said = [line for f in found.findings for line in wrap(f"{f.sure}: {f.what}", wide // 7)][:_LINES]
    top = 48 + 18 * max(1, len(said))
    sheet = Canvas(top + rows * tall, wide, 24)
    for at, line in enumerate(said):
        sheet.write(line, 8, 18 + 18 * at, (255, 255, 255))
    if not found.findings:
        sheet.write("nothing wrong", 8, 18, (120, 255, 120))
    x = 8
    for said_of, colour in _LEGEND:
        sheet.write(said_of, x, top - 12, colour)
        x += 7 * len(said_of) + 16
    for k, (picture, name, text) in enumerate(cells):
        y, x = top + k // columns * tall, 6 + k % columns * (_CELL + 6)
        sheet.paste(picture, x, y)
        sheet.write(name, x + 2, y + picture.shape[0] + 14, (230, 230, 230), _CELL)
        sheet.write(text, x + 2, y + picture.shape[0] + 30, (255, 170, 80), _CELL)
    return sheet.draw()


def _hulls_of_others(
    views: Views, masks: Sequence[Tensor | np.ndarray], found: Check
) -> dict[int, np.ndarray]:
    """Silhouettes, at the cells' size, of the hull of all usable views but the one."""
    usable = list(found.usable)
    if len(usable) < 2:
        return {}
    index = torch.tensor(usable)
    cameras = views.cameras[index]
    domain = VisibleDomain(resolution=_RESOLUTION, k=1)
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
        unknown = [
            None if (g := views.ignored(usable[i])) is None else _shrink(np.asarray(g), small[k])
            for k, i in enumerate(others)
        ]
        # The view itself is one of the K that see a point.
        rule = replace(domain, k=max(1, min(k - 1, len(others))))
        hull = carve_silhouettes(rule, small, gather_silhouettes(small, shrunk, unknown))
        camera = views.cameras[view]
        height = max(1, round(int(camera.height) * _CELL / int(camera.width)))
        if hull is None:
            result[view] = np.zeros((height, _CELL), bool)
        else:
            result[view] = depth_and_silhouette(hull, camera.resized(_CELL, height))[1].numpy()
    return result


def _contradicted(views: Views, masks: Sequence[Tensor | np.ndarray], found: Check) -> dict[int, np.ndarray]:
    """Per view, (h, w) bool: where every point of the ray lies beside the mask of another usable view."""
    if found.fit is None or found.fit.ball is None:
        return {}
    sizes = torch.stack([views.cameras.height, views.cameras.width], -1).tolist()
    shown = [i for i, m in enumerate(masks) if list(m.shape) == sizes[i] and m.any()]
    cameras = views.cameras[torch.tensor(shown)]
    unknown = [views.ignored(i) for i in shown]
    outlines = draw_outlines(cameras, gather_silhouettes(cameras, [masks[i] for i in shown], unknown))
    result = {}
    for at, view in enumerate(shown):
        index = np.array([k for k, i in enumerate(shown) if i in found.usable or i == view])
        if len(index) < 2:
            continue
        field = outlines.fields[at]
        # Every other pixel is enough for a picture.
        row, column = np.nonzero(((field < 0) & is_known(field))[::2, ::2])
        uv = np.stack([2 * column + 0.5, 2 * row + 0.5], -1)
        whose = np.full(len(uv), int(np.flatnonzero(index == at)[0]))
        rays = march_rays(outlines.keep(index), whose, uv, least=1, ball=found.fit.ball)
        wrong = np.zeros(field[::2, ::2].shape, bool)
        wrong[row, column] = (rays.whole > TOLERANCE_PX) & rays.counts
        result[view] = wrong
    return result


def _shrink(mask: np.ndarray, camera: Cameras) -> np.ndarray:
    size = int(camera.width), int(camera.height)
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)


def _draw_view(
    image: np.ndarray, mask: np.ndarray, hull: np.ndarray | None, wrong: np.ndarray | None
) -> np.ndarray:
    height = max(1, round(image.shape[0] * _CELL / image.shape[1]))
    way = cv2.INTER_AREA if image.shape[1] > _CELL else cv2.INTER_LINEAR
    picture = cv2.resize(np.ascontiguousarray(image), (_CELL, height), interpolation=way).astype(np.float32)
    mask = cv2.resize(mask.astype(np.uint8), (_CELL, height), interpolation=cv2.INTER_NEAREST) > 0
    grey = picture.mean(-1, keepdims=True)
    # Faded, so that a red object is not taken for a fault.
    picture = np.where(mask[..., None], 0.4 * picture + 0.6 * grey, 0.5 * grey)
    if hull is not None and hull.shape == mask.shape:
        room = hull & ~mask
        picture[room] = 0.75 * picture[room] + 0.25 * np.array(_ROOM)
    if wrong is not None:
        wrong = cv2.resize(wrong.astype(np.uint8), (_CELL, height), interpolation=cv2.INTER_NEAREST) > 0
        picture[wrong & mask] = 0.2 * picture[wrong & mask] + 0.8 * np.array(_WRONG)
    picture = picture.clip(0, 255).astype(np.uint8)
    for outline, colour in ((hull, _HULL), (mask, _MASK)):
        if outline is not None and outline.shape == mask.shape:
            lines, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, lines, -1, colour, 1, cv2.LINE_AA)
    return picture
