"""Faults to plant into a sound capture, each as a pure function of its views, and what must be said of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from visdom_plugin.geometry.cameras import Cameras, look_at_point, project
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.seeding import generator

GL = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))


@dataclass(frozen=True)
class Capture:
    """What a check sees."""

    cameras: Cameras
    images: tuple
    masks: tuple
    names: tuple

    def __len__(self) -> int:
        return len(self.names)


class Fault(NamedTuple):
    """A planted fault."""

    capture: Capture
    kind: str
    """The finding's kind that must come."""
    views: tuple[int, ...]
    """The views that must be named; empty when the fault is of the whole capture."""


class Verdict(NamedTuple):
    """How a check did on a planted fault."""

    mark: str
    """ "+" found and named alone, "~" found among several suspects or causes, "missed"."""
    sure: str
    beside: int
    """Findings that are not about the planted fault."""


def judge(fault: Fault, found) -> Verdict:
    """Compares a planted fault with what `check` found."""
    for finding in found.findings:
        if finding.kind == fault.kind and set(fault.views) <= set(finding.views):
            alone = set(fault.views) == set(finding.views) and "; or " not in finding.what
            return Verdict("+" if alone else "~", finding.sure, len(found.findings) - 1)
        if f"{fault.kind}" in finding.alternatives:
            return Verdict("~", finding.sure, len(found.findings) - 1)
    return Verdict("missed", "", len(found.findings))


def capture_of(views) -> Capture:
    """A capture from anything with cameras, images, masks and names."""
    return Capture(views.cameras, tuple(views.images), tuple(views.masks), tuple(views.names))


def _with(items, changes: dict) -> tuple:
    return tuple(changes.get(i, item) for i, item in enumerate(items))


def _mask(c: Capture, view: int, change: Callable) -> Capture:
    return replace(c, masks=_with(c.masks, {view: change(c.masks[view])}))


def _pose(c: Capture, view: int, motion) -> Capture:
    motions = c.cameras.world_from_camera.clone()
    motions[view] = motion(motions[view])
    return replace(c, cameras=replace(c.cameras, world_from_camera=motions))


def _intrinsics(c: Capture, view: int | slice, factors) -> Capture:
    K = c.cameras.intrinsics.clone()
    K[view] = K[view] * torch.tensor(factors, dtype=K.dtype)
    return replace(c, cameras=replace(c.cameras, intrinsics=K))


_FOCAL = lambda s: [[s, 1, 1], [1, s, 1], [1, 1, 1]]  # noqa: E731
_WHOLE = lambda s: [[s, 1, s], [1, s, s], [1, 1, 1]]  # noqa: E731


def inverted(c: Capture, v: int) -> Fault:
    """One mask marks the background."""
    return Fault(_mask(c, v, lambda m: ~m), "inverted", (v,))


def inverted_all(c: Capture, v: int) -> Fault:
    """All masks mark the background."""
    return Fault(replace(c, masks=tuple(~m for m in c.masks)), "inverted", tuple(range(len(c))))


def empty(c: Capture, v: int) -> Fault:
    """One mask without a foreground pixel."""
    return Fault(_mask(c, v, torch.zeros_like), "empty", (v,))


def full(c: Capture, v: int) -> Fault:
    """One mask without a background pixel."""
    return Fault(_mask(c, v, torch.ones_like), "full", (v,))


def cut_off(c: Capture, v: int) -> Fault:
    """One photograph cropped through the object, its camera along with it."""
    mask = c.masks[v]
    columns = mask.any(0).nonzero()[:, 0]
    at = int(columns.min() + 0.4 * (columns.max() - columns.min()))
    K, width = c.cameras.intrinsics.clone(), c.cameras.width.clone()
    K[v, 0, 2] -= at
    width[v] -= at
    cameras = replace(c.cameras, intrinsics=K, width=width)
    cropped = replace(c, cameras=cameras, images=_with(c.images, {v: c.images[v][:, at:]}))
    return Fault(_mask(cropped, v, lambda m: m[:, at:]), "border", (v,))


def speckled(c: Capture, v: int) -> Fault:
    """One mask with one pixel in a hundred turned over."""
    draw = torch.rand(c.masks[v].shape, generator=generator(0, "specks", v))
    return Fault(_mask(c, v, lambda m: m ^ (draw < 0.01)), "speckled", (v,))


def same_mask(c: Capture, v: int) -> Fault:
    """The mask of the next view in one view's place."""
    other = (v + 1) % len(c)
    return Fault(_mask(c, v, lambda m: _fit(c.masks[other], m)), "duplicate", (v, other))


def same_view(c: Capture, v: int) -> Fault:
    """Photograph and mask of the next view in one view's place."""
    fault = same_mask(c, v)
    other = fault.views[1]
    image = _fit(c.images[other], c.images[v])
    return fault._replace(capture=replace(fault.capture, images=_with(c.images, {v: image})))


def wrong_size(c: Capture, v: int) -> Fault:
    """One mask at half its image's size."""
    return Fault(_mask(c, v, lambda m: m[::2, ::2]), "size", (v,))


def opengl(c: Capture, v: int) -> Fault:
    """All poses with OpenGL's axes."""
    cameras = replace(c.cameras, world_from_camera=c.cameras.world_from_camera @ GL)
    return Fault(replace(c, cameras=cameras), "axes", ())


def opengl_one(c: Capture, v: int) -> Fault:
    """One pose with OpenGL's axes."""
    return Fault(_pose(c, v, lambda m: m @ GL), "view", (v,))


def inverse_poses(c: Capture, v: int) -> Fault:
    """World-to-camera matrices in the place of camera-to-world."""
    cameras = replace(c.cameras, world_from_camera=c.cameras.camera_from_world)
    return Fault(replace(c, cameras=cameras), "axes", ())


def swapped(c: Capture, v: int) -> Fault:
    """Photographs and masks of two views exchanged."""
    w = (v + 2) % len(c)
    masks = _with(c.masks, {v: _fit(c.masks[w], c.masks[v]), w: _fit(c.masks[v], c.masks[w])})
    images = _with(c.images, {v: _fit(c.images[w], c.images[v]), w: _fit(c.images[v], c.images[w])})
    return Fault(replace(c, masks=masks, images=images), "swapped", tuple(sorted((v, w))))


def shifted_order(c: Capture, v: int) -> Fault:
    """Every view has the photograph and the mask of the one before."""
    masks = tuple(_fit(c.masks[i - 1], c.masks[i]) for i in range(len(c)))
    images = tuple(_fit(c.images[i - 1], c.images[i]) for i in range(len(c)))
    return Fault(replace(c, masks=masks, images=images), "order", ())


def focal_double(c: Capture, v: int) -> Fault:
    """Focal lengths twice too long, principal points right."""
    return Fault(_intrinsics(c, slice(None), _FOCAL(2)), "scale", ())


def focal_half(c: Capture, v: int) -> Fault:
    """Focal lengths twice too short, principal points right."""
    return Fault(_intrinsics(c, slice(None), _FOCAL(0.5)), "scale", ())


def unscaled_double(c: Capture, v: int) -> Fault:
    """Images shrunk to half their size, intrinsics left as they were."""
    return Fault(_intrinsics(c, slice(None), _WHOLE(2)), "scale", ())


def unscaled_half(c: Capture, v: int) -> Fault:
    """Intrinsics of images half the size."""
    return Fault(_intrinsics(c, slice(None), _WHOLE(0.5)), "scale", ())


def focal_one(c: Capture, v: int) -> Fault:
    """One focal length twice too long."""
    return Fault(_intrinsics(c, v, _FOCAL(2)), "view", (v,))


def turned_about(c: Capture, v: int, axis: Sequence[float], degrees: float) -> Capture:
    """One camera turned about an axis of its own."""
    half = math.radians(degrees) / 2
    unit = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = matrix_from_quaternion(torch.cat([torch.tensor([math.cos(half)]), math.sin(half) * unit]))
    return _pose(c, v, lambda m: m @ turn)


def turned(c: Capture, v: int) -> Fault:
    """One camera turned by 5 degrees about a slanted axis."""
    return Fault(turned_about(c, v, (1.0, -1.0, 0.5), 5), "view", (v,))


def moved(c: Capture, v: int) -> Fault:
    """One camera moved aside by a tenth of its distance."""
    distance = (c.cameras.centres[v] - look_at_point(c.cameras)).norm()
    move = torch.eye(4, dtype=torch.float64)
    move[:3, 3] = 0.1 * distance * torch.tensor([0.8, -0.6, 0.0])
    return Fault(_pose(c, v, lambda m: m @ move), "view", (v,))


def half_mask(c: Capture, v: int) -> Fault:
    """One mask without its lower half."""

    def lose(mask):
        rows = mask.any(1).nonzero()[:, 0]
        mask = mask.clone()
        mask[int(rows.float().mean()) :] = False
        return mask

    return Fault(_mask(c, v, lose), "view", (v,))


def shifted_mask(c: Capture, v: int) -> Fault:
    """One mask moved by a twelfth of its image."""

    def shift(mask):
        by = (mask.shape[0] // 12, mask.shape[1] // 12)
        moved = torch.zeros_like(mask)
        moved[by[0] :, by[1] :] = mask[: mask.shape[0] - by[0], : mask.shape[1] - by[1]]
        return moved

    return Fault(_mask(c, v, shift), "view", (v,))


def mirrored_mask(c: Capture, v: int) -> Fault:
    """One mask mirrored left to right."""
    return Fault(_mask(c, v, lambda m: m.flip(1)), "view", (v,))


def clustered(c: Capture, v: int, count: int = 3) -> Fault:
    """Only the views of a dense capture that look most nearly from the side that one does."""
    lines = torch.nn.functional.normalize(c.cameras.centres - look_at_point(c.cameras), dim=-1)
    near = (lines @ lines[v]).argsort(descending=True)[:count]
    images, masks, names = (tuple(items[i] for i in near.tolist()) for items in (c.images, c.masks, c.names))
    return Fault(Capture(c.cameras[near], images, masks, names), "clustered", ())


def seen_alone(c: Capture, v: int, part: torch.Tensor) -> Capture:
    """All other photographs cropped, their cameras along with them, so that one view alone shows a part.

    Args:
        part: (P, 3) points of it.
    """
    uv, _ = project(c.cameras, part)
    K, size = c.cameras.intrinsics.clone(), torch.stack([c.cameras.width, c.cameras.height], -1)
    images, masks = list(c.images), list(c.masks)
    for i in range(len(c)):
        if i == v:
            continue
        (left, top), (right, bottom) = uv[i].amin(0).int().tolist(), uv[i].amax(0).int().tolist()
        across = [slice(max(left, 1)), slice(max(right + 1, 0), None)]
        down = [slice(max(top, 1)), slice(max(bottom + 1, 0), None)]
        crops = [(slice(None), columns) for columns in across] + [(rows, slice(None)) for rows in down]
        rows, columns = max(crops, key=lambda crop: int(masks[i][crop].sum()))
        K[i, 0, 2] -= columns.start or 0
        K[i, 1, 2] -= rows.start or 0
        images[i], masks[i] = images[i][rows, columns], masks[i][rows, columns]
        size[i] = torch.tensor(masks[i].shape[::-1])
    cameras = replace(c.cameras, intrinsics=K, width=size[:, 0], height=size[:, 1])
    return Capture(cameras, tuple(images), tuple(masks), c.names)


FAULTS: dict[str, Callable[[Capture, int], Fault]] = {
    f.__name__: f
    for f in (
        inverted, inverted_all, empty, full, cut_off, speckled, same_mask, same_view, wrong_size, opengl,
        opengl_one, inverse_poses, swapped, shifted_order, focal_double, focal_half, unscaled_double,
        unscaled_half, focal_one, turned, moved, half_mask, shifted_mask, mirrored_mask,
    )
}  # fmt: skip


def _fit(pixels: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Pixels (H, W, ...) at another view's size, by the nearest."""
    if pixels.shape == like.shape:
        return pixels
    rows = np.arange(like.shape[0]) * pixels.shape[0] // like.shape[0]
    columns = np.arange(like.shape[1]) * pixels.shape[1] // like.shape[1]
    return pixels[rows][:, columns]
