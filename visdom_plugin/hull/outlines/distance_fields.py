"""Masks as distance fields at low resolution, with the cameras that go with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import Silhouettes

OBJECT_PX = 128
"""Pixels along the longest side of the typical mask that the fields are made for."""
MOST_PX = 512
"""Pixels along the longest side of a field, for objects that are small in the frame."""
_FAR = 1e6
_UNKNOWN = -1e7
"""Value of a field where nothing is known: as far inside as can be, so that it rules nothing out."""
UNKNOWN_BELOW = -2 * _FAR
"""Values below, also interpolated ones, are of what is unknown: there a view sees nothing."""


@dataclass(frozen=True)
class Outlines:
    """Masks of one capture as distance fields, at low resolution."""

    rotations: np.ndarray
    """(N, 3, 3) float64 world from camera, OpenCV axes."""
    centres: np.ndarray
    """(N, 3) float64 camera centres, world frame."""
    intrinsics: np.ndarray
    """(N, 3, 3) float64 in the fields' pixels."""
    fields: tuple[np.ndarray, ...]
    """N arrays (h, w) float32: pixels from each pixel's centre to the mask's outline, negative inside and where
    nothing is known (see `is_known`)."""

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def projections(self) -> np.ndarray:
        """(N, 3, 4) float64: world point to homogeneous pixel coordinates and depth."""
        world = self.rotations.transpose(0, 2, 1)
        moved = -(world @ self.centres[:, :, None])
        return np.ascontiguousarray(self.intrinsics @ np.concatenate([world, moved], -1))

    def keep(self, views: np.ndarray) -> Outlines:
        """Only some of the views, by index or as a (N,) bool array."""
        index = np.arange(len(self))[views]
        fields = tuple(self.fields[i] for i in index)
        return Outlines(self.rotations[index], self.centres[index], self.intrinsics[index], fields)

    def with_fields(self, fields: Sequence[np.ndarray]) -> Outlines:
        """Other masks for the same cameras; a field of another size is stretched to its camera's."""
        fitted = []
        for field, own in zip(fields, self.fields, strict=True):
            if field.shape != own.shape:
                factor = max(own.shape) / max(field.shape)
                field = cv2.resize(field, own.shape[::-1], interpolation=cv2.INTER_LINEAR) * factor
            fitted.append(np.ascontiguousarray(field, np.float32))
        return replace(self, fields=tuple(fitted))


def draw_outlines(cameras: Cameras, silhouettes: Silhouettes, *, object_px: int = OBJECT_PX) -> Outlines:
    """Distance fields of masks at low resolution.

    Args:
        cameras: (N,) the ones of `silhouettes`.
        object_px: how long a typical object becomes, in pixels.
    """
    sides = silhouettes.sizes.max(1)
    known = silhouettes.demanding()
    lengths = np.array([_length(known.mask(view)) for view in range(len(known))]) / sides
    most = MOST_PX * object_px / OBJECT_PX
    longest = min(object_px / float(np.median(lengths[lengths > 0])), most) if lengths.any() else object_px
    fields, ratios = [], []
    for view in range(len(silhouettes)):
        mask = silhouettes.mask(view)
        factor = min(1.0, longest / sides[view])
        width, height = (max(1, round(s * factor)) for s in silhouettes.sizes[view].tolist())
        field, unknown = signed_distance(_shrink(mask, width, height)), silhouettes.unknown_in(view)
        if unknown is not None:
            # What is unknown in part is unknown.
            share = cv2.resize(unknown.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
            field[share > 0] = _UNKNOWN
        fields.append(field)
        ratios.append((width / mask.shape[1], height / mask.shape[0], 1.0))
    motion = cameras.world_from_camera.double().cpu().numpy()
    scaled = cameras.intrinsics.double().cpu().numpy() * np.array(ratios)[:, :, None]
    return Outlines(motion[:, :3, :3].copy(), motion[:, :3, 3].copy(), scaled, tuple(fields))


def is_known(field: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a field that say something."""
    return field > UNKNOWN_BELOW


def turn_over(field: np.ndarray) -> np.ndarray:
    """The field of the inverted mask; what is unknown stays so."""
    return np.where(is_known(field), -field, field)


def _length(mask: np.ndarray) -> int:
    """Longest side, in pixels, of the box around a mask's (H, W) foreground; 0 for an empty mask."""
    return max(cv2.boundingRect(mask.astype(np.uint8))[2:])


def _shrink(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    if mask.shape == (height, width):
        return mask.astype(bool)
    small = cv2.resize(mask * np.uint8(255), (width, height), interpolation=cv2.INTER_AREA)
    return small > 127


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 pixels to the outline, negative inside; far away where there is no outline."""
    mask = mask.astype(np.uint8)
    if not mask.any():
        return np.full(mask.shape, _FAR, np.float32)
    if mask.all():
        return np.full(mask.shape, -_FAR, np.float32)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    return np.where(mask > 0, 0.5 - inside, outside - 0.5).astype(np.float32)
