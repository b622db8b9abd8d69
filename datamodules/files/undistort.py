"""Lens distortion taken out of photographs and their masks together, through OpenCV.

The corrected picture has the photograph's size and intrinsics: focal lengths and principal point are kept, and
so is every ray through them. What lies in the corrected frame but not in the photograph is `ignore`d, never
filled in. Models and the order of their coefficients are COLMAP's, which are OpenCV's
(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from visdom_plugin.errors import SceneError

COEFFICIENTS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 0,
    "SIMPLE_RADIAL": 1,  # k1
    "RADIAL": 2,  # k1 k2
    "OPENCV": 4,  # k1 k2 p1 p2
    "FULL_OPENCV": 8,  # k1 k2 p1 p2 k3 k4 k5 k6
    "SIMPLE_RADIAL_FISHEYE": 1,  # k1 of the angle
    "RADIAL_FISHEYE": 2,  # k1 k2 of the angle
    "OPENCV_FISHEYE": 4,  # k1 k2 k3 k4 of the angle
}
"""The lens models that can be undistorted, and how many coefficients each has."""
FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
"""Of these, the ones that bend the angle; each has the first coefficients of the last one, and no others."""
LEAST_KEPT = 0.5
"""A lens model that finds less of its frame in the photograph than this is taken for damaged."""


@dataclass(frozen=True)
class Distortion:
    """A lens model without its focal lengths and principal point. Independent of the image's size."""

    model: str
    """COLMAP's name, one of `COEFFICIENTS` to be of use."""
    coefficients: tuple[float, ...] = ()
    """In the order of `COEFFICIENTS`."""

    @property
    def absent(self) -> bool:
        """True where there is nothing to correct."""
        return self.model in COEFFICIENTS and self.model not in FISHEYES and not any(self.coefficients)

    def check(self, where: object = None) -> None:
        """Raises SceneError, with the reason, for a model or coefficients that cannot be undistorted."""
        if self.model not in COEFFICIENTS:
            raise SceneError(
                f"the lens model {self.model} cannot be undistorted here; possible are "
                + ", ".join(COEFFICIENTS),
                where=where,
                cause="OpenCV has no inverse of this model",
                todo=advise_undistorting(),
                topic="lens",
            )
        expected = COEFFICIENTS[self.model]
        if len(self.coefficients) != expected or not all(abs(c) < 1e9 for c in self.coefficients):
            raise SceneError(
                f"the lens model {self.model} needs {expected} finite coefficients, not {self.coefficients}",
                where=where,
                cause="a damaged file, or a calibration that failed",
                todo="export the cameras again",
                topic="lens",
            )


def advise_undistorting(model: str = "sparse/0") -> str:
    """What to do about a lens that is not undistorted here: photographs and masks must go the same way.

    Args:
        model: COLMAP's model, relative to the capture's folder.
    """
    command = f"colmap image_undistorter --input_path {model}"
    return (
        f"undistort the photographs ({command} --image_path images --output_path DIR) and the masks, each named "
        f"as its photograph, ending included ({command} --image_path masks --output_path DIR_masks); then move "
        "DIR_masks/images to DIR/masks and use DIR. Ignored pixels go the way of the masks"
    )


class Undistorted(NamedTuple):
    """A photograph as a pinhole camera of the same intrinsics would have taken it."""

    image: np.ndarray
    """(H, W, ...) as the input, interpolated bilinearly; the photograph's edge repeated where ignored."""
    mask: np.ndarray | None
    """(H, W) type of the input, nearest pixel; False or 0 where ignored."""
    ignore: np.ndarray | None
    """(H, W) bool, True where the photograph shows nothing or was ignored already; None where nowhere."""


def undistort(
    intrinsics: np.ndarray,
    distortion: Distortion,
    image: np.ndarray,
    mask: np.ndarray | None = None,
    ignore: np.ndarray | None = None,
    *,
    where: object = None,
) -> Undistorted:
    """Corrects a photograph, its mask and its ignored pixels with one and the same map.

    Args:
        intrinsics: (3, 3) pixels of these very arrays (scaled with them), origin at the image's corner as
            everywhere here: the first pixel's centre is (0.5, 0.5).
        distortion: of the lens.
        image: (H, W) or (H, W, C), uint8, uint16 or float32.
        mask: (H, W) bool, uint8 or float32, or None.
        ignore: (H, W) bool, or None.
        where: the file or view, for messages.

    Raises:
        SceneError: for another lens model, impossible coefficients, or a model that finds less than half of
            the frame in the photograph.
    """
    import cv2

    distortion.check(where)
    if distortion.absent:
        return Undistorted(image, mask, ignore)
    height, width = image.shape[:2]
    columns, rows, lost = _find_sources(np.asarray(intrinsics, np.float64), distortion, width, height)
    if lost.mean() > 1 - LEAST_KEPT:
        raise SceneError(
            f"the lens model {distortion.model} {distortion.coefficients} leaves {1 - lost.mean():.0%} of the "
            f"{width} x {height} frame",
            where=where,
            cause="coefficients in another order or unit, or a calibration that failed",
            todo="calibrate again, or undistort the photographs with the program that made the model",
            topic="lens",
        )

    def nearest(values: np.ndarray) -> np.ndarray:
        raw = values.view(np.uint8) if values.dtype == bool else values
        moved = cv2.remap(raw, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        moved[lost] = 0
        return moved.view(bool) if values.dtype == bool else moved

    unknown = lost if ignore is None else lost | nearest(np.ascontiguousarray(ignore, bool))
    return Undistorted(
        cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        None if mask is None else nearest(np.ascontiguousarray(mask)),
        unknown if unknown.any() else None,
    )


def _find_sources(
    K: np.ndarray, distortion: Distortion, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each corrected pixel lies in the photograph.

    Returns:
        columns and rows (H, W) float32 in OpenCV's pixels (first centre at 0), lost (H, W) bool.
    """
    import cv2

    K = K.copy()
    K[:2, 2] -= 0.5  # OpenCV's origin is the first pixel's centre, ours the image's corner
    k = np.zeros(4 if distortion.model in FISHEYES else 8)
    k[: len(distortion.coefficients)] = distortion.coefficients
    make = cv2.fisheye.initUndistortRectifyMap if len(k) == 4 else cv2.initUndistortRectifyMap
    columns, rows = make(K, k, np.eye(3), K, (width, height), cv2.CV_32FC1)
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    y = (np.arange(height) - K[1, 2]) / K[1, 1]
    radius = np.hypot(x[None], y[:, None])
    inside = (columns >= -0.5) & (columns < width - 0.5) & (rows >= -0.5) & (rows < height - 0.5)
    return columns, rows, ~inside | (radius >= _folds_at(k, float(radius.max())))


def _folds_at(k: np.ndarray, most: float) -> float:
    """The radius x / z, up to `most`, where the radial polynomial turns round; infinity where it does not.

    Beyond it the model maps two rays to one place of the photograph: the inner one is right.
    """
    r = np.linspace(0, most, 2048)
    if len(k) == 4:
        s = np.arctan(r)
        bent = s * (1 + s**2 * (k[0] + s**2 * (k[1] + s**2 * (k[2] + s**2 * k[3]))))
    else:
        s = r**2
        above, below = 1 + s * (k[0] + s * (k[1] + s * k[4])), 1 + s * (k[5] + s * (k[6] + s * k[7]))
        with np.errstate(divide="ignore", invalid="ignore"):
            bent = np.where(below > 0, r * above / below, -np.inf)
    falling = np.flatnonzero(~(np.diff(bent) > 0))
    return float(r[falling[0]]) if len(falling) else math.inf
