"""Intrinsics that are no pixels but look like such.

Of focal lengths (angles in degrees, millimetres, one angle for both axes) the numbers alone cannot tell, so each
reading is tried: it is believed where the masks fit together far better with it than as given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.checks.findings import Finding, Sure

if TYPE_CHECKING:
    from visdom_plugin.hull.outlines.distance_fields import Outlines

LEAST, LARGEST_ANGLE, LARGEST_MM = 5.0, 170.0, 600.0
"""Focal lengths from the first on and up to the others may be degrees, or millimetres."""
_FULL_FRAME_MM = 36.0
_WIDE_DEGREES = 100.0
_MIDDLE = 0.25
"""Principal points further than this from the images' centres, in image sizes, are outside their middle half."""
_RAYS = 1024
_LEAST_PX, _MOST_PX, _RATIO, _POWER = 0.004, 0.1, 0.35, 0.8
"""Misfit (pixels of the fields) from which readings are compared, the most that a better one may leave, also as a
part of it; and how much of the masks' power to contradict it must."""


_FAINT_PX, _FAINT_RATIO = 0.0007, 0.2
"""The same of small pictures, in which a focal length that is off by a quarter moves outlines by less than what
usual masks are off: only clean ones tell, and then faintly."""
_LONGER, _SHORTER = (1.1, 1.25, 1.5, 2.0), (0.9, 0.8, 0.67, 0.5)
_QUIET_PX, _RANGE_RAYS = 0.015, 512


class _Reading(NamedTuple):
    what: str
    todo: str
    focal: np.ndarray
    """(N, 2) pixels."""


def may_be_other_units(cameras: Cameras) -> bool:
    """Whether the numbers of cameras (N,) leave another unit open; costs nothing."""
    return next(_readings(*_numbers(cameras)), None) is not None


def find_other_unit(
    cameras: Cameras, outlines: Outlines, *, faint: bool = False
) -> tuple[list[Finding], Outlines]:
    """The finding that focal lengths are in another unit, none or one; and the outlines with that undone.

    Args:
        cameras: (N,) the ones of the outlines.
        faint: also believe what moves outlines by less than usual masks are off.
    """
    # Every carve asks `may_be_other_units`; the masks are compared only then, and by OpenCV.
    from visdom_plugin.hull.checks.causes.fault_hypotheses import find_causes
    from visdom_plugin.hull.outlines.distance_fields import OBJECT_PX
    from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence

    focal, size = _numbers(cameras)
    readings = list(_readings(focal, size))
    if not readings or len(outlines) < 2:
        return [], outlines
    rays = max(_RAYS // len(outlines), 16)
    fit = measure_coherence(outlines, rays)
    loud = fit.score >= _LEAST_PX
    if not loud and not (faint and fit.score >= _FAINT_PX):
        return [], outlines
    trials = []
    for reading in readings:
        K = outlines.intrinsics.copy()
        K[:, [0, 1], [0, 1]] *= reading.focal / focal
        changed = replace(outlines, intrinsics=K)
        trials.append((measure_coherence(changed, rays), reading, changed))
    after, best, changed = min(trials, key=lambda trial: trial[0].score)
    ratio = _RATIO if loud else _FAINT_RATIO
    if after.score > min(ratio * fit.score, _MOST_PX) or after.power < _POWER * fit.power:
        return [], outlines
    # Poses with other axes look into the object's mirror image; a wide enough lens explains that, too.
    causes, left, _ = find_causes(outlines, brief=True)
    if any(cause.kind == "axes" for cause in causes) and left.score < after.score:
        return [], outlines
    rivals = [
        r.what for f, r, _ in trials if r is not best and f.score <= max(2 * after.score, _LEAST_PX / 2)
    ]
    before, misses = (f"{100 * f.score / OBJECT_PX:.1g} %" for f in (fit, after))
    (fx, fy), mended = np.median(focal, 0), np.median(best.focal, 0)
    what = (
        f"the focal lengths ({fx:.4g}, {fy:.4g}) are {' or '.join([best.what, *rivals[:2]])}: read so, masks "
        f"and cameras miss each other by {misses} of the object's length in the mean in place of {before}"
    )
    todo = f"give pixels, here about ({mended[0]:.4g}, {mended[1]:.4g}): {best.todo}"
    sure: Sure = "likely" if loud and not rivals else "possible"
    return [Finding("scale", what, (), sure, 1 - after.score / fit.score, todo)], changed


def measure_focal_range(outlines: Outlines, score: float) -> tuple[float, float]:
    """How many times shorter and longer all focal lengths could be with masks that fit about as well.

    Of cameras that look at one point from afar, another focal length makes the hull larger or smaller and hardly
    moves it in any view. What tells is perspective alone, and in small pictures it stays below what rounding to
    pixels and the masks' own errors amount to.

    Args:
        score: misfit as given, in pixels of the fields.

    Returns:
        the smallest factor, at least 0.5, and the largest, at most 2; 1 for none.
    """
    from visdom_plugin.hull.outlines.silhouette_consistency import measure_coherence

    limit, rays = max(_QUIET_PX, 2 * score), max(_RANGE_RAYS // len(outlines), 16)
    reached = []
    for factors in (_SHORTER, _LONGER):
        last = 1.0
        for factor in factors:
            K = outlines.intrinsics.copy()
            K[:, [0, 1], [0, 1]] *= factor
            if measure_coherence(replace(outlines, intrinsics=K), rays, power=False).score > limit:
                break
            last = factor
        reached.append(last)
    return reached[0], reached[1]


def describe_suspicion(cameras: Cameras) -> str | None:
    """What is odd about the focal lengths of cameras (N,) that masks did not decide, or None."""
    focal, size = _numbers(cameras)
    fx, fy = np.median(focal, 0)
    angle = float(np.degrees(2 * np.arctan(np.median(size[:, 0] / focal[:, 0]) / 2)))
    if _same_shape(focal, size):
        return (
            f"fx / fy is {fx / fy:.4g}, which is width / height: an angle of view or a fraction of one axis that "
            "was taken for both? Pixels are nearly always square, fx = fy"
        )
    if max(fx, fy) <= LARGEST_ANGLE and angle > _WIDE_DEGREES:
        return (
            f"a focal length of {fx:.4g} pixels means an angle of view of {angle:.0f} degrees; were it degrees or "
            "millimetres, the hull would be wrong: fx = width / (2 tan(angle / 2))"
        )
    return None


def find_astray(cameras: Cameras) -> Finding | None:
    """The finding on principal points outside the middle half of most images."""
    K = cameras.intrinsics.double().cpu().numpy()
    points = K[:, :2, 2]
    shares = points / _numbers(cameras)[1]
    out = np.abs(shares - 0.5).max(1) > _MIDDLE
    if 2 * out.sum() <= len(out):
        return None
    (x, y), (across, down) = np.median(points, 0), np.median(shares, 0)
    normalised = bool((points <= 1).all(1).mean() > 0.5)
    return Finding(
        "principal",
        f"the principal points (cx, cy) lie at ({x:.4g}, {y:.4g}) pixels, {across:.0%} of the images' width and "
        f"{down:.0%} of their height, and the views do not fit together",
        (),
        "certain" if normalised else "likely",
        float(out.mean()),
        "multiply cx by the width and cy by the height: they are normalised"
        + (", and so are fx and fy" if cameras.intrinsics[..., 0, 0].double().median() < 4 else "")
        if normalised
        else "give cx and cy in pixels from the image's upper left corner, and scale them with the images",
    )


def _numbers(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    K = cameras.intrinsics.double().cpu().numpy()
    size = np.stack([cameras.width.cpu().numpy(), cameras.height.cpu().numpy()], -1)
    return K[:, [0, 1], [0, 1]], size.astype(np.float64)


def _same_shape(focal: np.ndarray, size: np.ndarray) -> bool:
    """Whether fx / fy is the images' width / height, and these are not square."""
    shape = size[:, 0] / size[:, 1]
    return bool(
        (np.abs(focal[:, 0] / focal[:, 1] / shape - 1) < 1e-3).all() and (np.abs(shape - 1) > 0.02).any()
    )


def _readings(focal: np.ndarray, size: np.ndarray) -> Iterator[_Reading]:
    """Other units that focal lengths (N, 2) for images of size (N, 2) could be in."""
    if focal.min() < LEAST:
        return
    degrees = "an angle of view in degrees across the "
    if focal.max() <= LARGEST_ANGLE:
        half = np.tan(np.radians(focal) / 2)
        across = {"width": size[:, 0], "height": size[:, 1], "diagonal": np.hypot(*size.T)}
        for name, length in across.items() if np.allclose(focal[:, 0], focal[:, 1], rtol=1e-6) else ():
            yield _Reading(degrees + name, f"{name} / (2 tan(angle / 2))", length[:, None] / 2 / half)
        if not np.allclose(focal[:, 0], focal[:, 1], rtol=1e-6):
            todo = "fx = width / (2 tan(angle / 2)), fy alike"
            yield _Reading("angles of view in degrees", todo, size / 2 / half)
    if focal.max() <= LARGEST_MM and (focal < size.max(1)[:, None] / 2).all():
        todo = "focal length in mm * width / 36"
        yield _Reading("millimetres of full frame", todo, focal * size.max(1)[:, None] / _FULL_FRAME_MM)
    if _same_shape(focal, size):
        for axis, name in enumerate(("width", "height")):
            todo = f"fx = fy = {('fx', 'fy')[axis]}"
            yield _Reading(f"made of one angle for both axes, the {name}'s", todo, focal[:, [axis, axis]])
