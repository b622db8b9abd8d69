"""Silhouette consistency: how well silhouettes and cameras fit each other, ray by ray.

Every ray through a mask meets the object, so some point of it must lie inside the masks of all views that see
it (silhouette coherence; Hernandez, Schmitt and Cipolla, PAMI 2007). A ray's residual is how far, in pixels,
the masks would have to grow to make that true; it is also known with any one of the views left out. No grid is
carved: rays are marched through the masks' distance fields in steps of one pixel of the fastest view.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.hull.outlines.distance_fields import UNKNOWN_BELOW, Outlines, is_known

CAP_PX = 16.0
"""Residuals are cut off here: beyond it, wrong is wrong."""
_HIT_PX = 0.05
_BESIDE_PX = (6.0, 14.0)
_NEAR = 0.02
"""Nothing counts nearer to a camera than this part of the cameras' spread."""


class Residuals(NamedTuple):
    """The result of `march_rays`: rays in rows, grouped by their view."""

    view: np.ndarray
    """(R,) int64."""
    whole: np.ndarray
    """(R,) pixels, against all other views; at most CAP_PX."""
    without: np.ndarray
    """(R, N) pixels, with one of the other views left out."""
    ends: np.ndarray
    """(R, 2, 3) first and last of the best points of each ray, world frame; only when no ball was given."""
    counts: np.ndarray
    """(R,) bool: False where a part of the ray near the object is seen by no other view, so that nothing can
    be said."""


@kernel()
def _cut(c0: float, c1: float, low: float, high: float) -> tuple[float, float]:
    """The part of [low, high] where c0 + c1 t >= 0."""
    if c1 > 0:
        low = max(low, -c0 / c1)
    elif c1 < 0:
        high = min(high, -c0 / c1)
    elif c0 < 0:
        high = low - 1.0
    return low, high


@kernel()
def _follow_rays(
    begin: int, end: int, view: np.ndarray, uv: np.ndarray, motions: np.ndarray, centres: np.ndarray,
    intrinsics: np.ndarray, projections: np.ndarray, sizes: np.ndarray, offsets: np.ndarray,
    fields: np.ndarray, least: int, near: float, far: float, ball: np.ndarray, radius: float, step: float,
    whole: np.ndarray, without: np.ndarray, ends: np.ndarray, counts: np.ndarray,
) -> None:  # fmt: skip
    views = len(sizes)
    start, slope, rate = np.empty((views, 3)), np.empty((views, 3)), np.empty(views)
    for r in range(begin, end):
        i = view[r]
        x = (uv[r, 0] - intrinsics[i, 0, 2]) / intrinsics[i, 0, 0]
        y = (uv[r, 1] - intrinsics[i, 1, 2]) / intrinsics[i, 1, 1]
        o = centres[i]
        d = np.empty(3)
        length = np.sqrt(x * x + y * y + 1.0)
        for c in range(3):
            d[c] = (motions[i, c, 0] * x + motions[i, c, 1] * y + motions[i, c, 2]) / length
        # Points o + t d in homogeneous pixels of each view: start + t slope.
        low, high = np.inf, -np.inf
        for j in range(views):
            for c in range(3):
                p = projections[j, c]
                start[j, c] = p[0] * o[0] + p[1] * o[1] + p[2] * o[2] + p[3]
                slope[j, c] = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
            fu = slope[j, 0] * start[j, 2] - start[j, 0] * slope[j, 2]
            fv = slope[j, 1] * start[j, 2] - start[j, 1] * slope[j, 2]
            rate[j] = np.sqrt(fu * fu + fv * fv)
            if j == i:
                continue
            width, height = sizes[j, 0], sizes[j, 1]
            a, b = _cut(start[j, 2] - near, slope[j, 2], near, far)
            a, b = _cut(start[j, 0], slope[j, 0], a, b)
            a, b = _cut(width * start[j, 2] - start[j, 0], width * slope[j, 2] - slope[j, 0], a, b)
            a, b = _cut(start[j, 1], slope[j, 1], a, b)
            a, b = _cut(height * start[j, 2] - start[j, 1], height * slope[j, 2] - slope[j, 1], a, b)
            if a < b:
                low, high = min(low, a), max(high, b)
        if radius > 0:
            along = (ball[0] - o[0]) * d[0] + (ball[1] - o[1]) * d[1] + (ball[2] - o[2]) * d[2]
            off = 0.0
            for c in range(3):
                off += (o[c] + along * d[c] - ball[c]) ** 2
            # What few views see was left out when the ball was placed and may lie beside it.
            half = max(np.sqrt(max(radius * radius - off, 0.0)), 0.75 * radius)
            low, high = max(along - half, near), along + half
        best, begin_t, end_t = CAP_PX, 0.0, 0.0
        for j in range(views):
            without[r, j] = CAP_PX
        t = low
        unseen = (high - low) / 64
        while t < high:
            seen, first, second, worst, speed = 0, 0.0, 0.0, -1, 0.0
            for j in range(views):
                if j == i:
                    continue
                w = start[j, 2] + t * slope[j, 2]
                if w <= near:
                    continue
                u = (start[j, 0] + t * slope[j, 0]) / w
                v = (start[j, 1] + t * slope[j, 1]) / w
                width, height = sizes[j, 0], sizes[j, 1]  # a row of an array would be counted
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                speed = max(speed, rate[j] / (w * w))
                # Bilinear between pixel centres.
                a, b = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
                column, row = min(int(a), max(width - 2, 0)), min(int(b), max(height - 2, 0))
                a, b = a - column, b - row
                at = offsets[j] + row * width + column
                right, down = (1 if width > 1 else 0), (width if height > 1 else 0)
                value = (1 - b) * ((1 - a) * fields[at] + a * fields[at + right]) + b * (
                    (1 - a) * fields[at + down] + a * fields[at + down + right]
                )
                if value < UNKNOWN_BELOW:
                    continue
                seen += 1
                if value > first:
                    first, second, worst = value, first, j
                elif value > second:
                    second = value
                if second > CAP_PX:
                    # Two views rule the point out, whatever the others say.
                    break
            if seen >= least:
                if first < best - 0.5:
                    begin_t, end_t = t, t
                elif first <= best + 0.5:
                    end_t = t
                best = min(best, first)
                if worst >= 0 and second < without[r, worst]:
                    without[r, worst] = second
                if best <= _HIT_PX and radius > 0:
                    break
            elif radius > 0 and seen == 0:
                counts[r] = False
            # Fields change by at most one pixel per pixel, so what is far above the cap may be skipped.
            skip = min(max(second - CAP_PX, 1.0), 8.0)
            t += step * skip / speed if speed * unseen > step * skip else unseen
        whole[r] = best
        for j in range(views):
            without[r, j] = min(without[r, j], best)
        for c in range(3):
            ends[r, 0, c], ends[r, 1, c] = o[c] + begin_t * d[c], o[c] + end_t * d[c]


def choose_pixels(
    outlines: Outlines, per_view: int, *, beside: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Rays to march: in each mask, half of them along the outline and half anywhere inside, evenly spread.

    Args:
        beside: rays that pass the mask at _BESIDE_PX instead.

    Returns:
        view (R,) int64 and uv (R, 2) float64 in the fields' pixels.
    """
    views, pixels = [], []
    for i, field in enumerate(outlines.fields):
        groups: tuple[np.ndarray, ...]
        if beside:
            groups = (np.flatnonzero((field > _BESIDE_PX[0]) & (field < _BESIDE_PX[1])),)
        else:
            groups = (
                np.flatnonzero((field < 0) & (field > -2)),
                np.flatnonzero((field <= -2) & is_known(field)),
            )
        for group in groups:
            count = min(len(group), per_view // len(groups))
            if count == 0:
                continue
            # Bresenham's spacing over the row-major order; a stride would fall into columns.
            chosen = group[np.arange(count) * len(group) // count]
            row, column = np.divmod(chosen, field.shape[1])
            views.append(np.full(count, i))
            pixels.append(np.stack([column + 0.5, row + 0.5], -1))
    if not views:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    return np.concatenate(views).astype(np.int64), np.concatenate(pixels)


def march_rays(
    outlines: Outlines,
    view: np.ndarray,
    uv: np.ndarray,
    *,
    least: int,
    ball: tuple[np.ndarray, float] | None = None,
    step_px: float = 1.0,
) -> Residuals:
    """Residuals of rays against the other views.

    Args:
        view: (R,) the view of each ray.
        uv: (R, 2) its pixel, in the fields' pixels.
        least: a point counts when at least this many other views see it.
        ball: (centre, radius) to stay near; by default rays are followed as far as any other view sees them.
        step_px: how far the fastest projection moves between two points.
    """
    count, views = len(view), len(outlines)
    sizes = np.array([f.shape[::-1] for f in outlines.fields], np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes.prod(1))[:-1]]).astype(np.int64)
    fields = np.concatenate([f.ravel() for f in outlines.fields])
    spread_of_cameras = np.linalg.norm(outlines.centres - outlines.centres.mean(0), axis=1)
    far = 8.0 * (float(spread_of_cameras.max()) or 1e-9)
    near = _NEAR * (float(np.median(spread_of_cameras)) or 1e-9)
    centre, radius = (
        (np.zeros(3), -1.0) if ball is None else (np.asarray(ball[0], np.float64), float(ball[1]))
    )
    whole, without = np.empty(count), np.empty((count, views))
    ends, counts = np.empty((count, 2, 3)), np.ones(count, np.bool_)
    parallel_for(
        _follow_rays, count, 64, view, uv, outlines.rotations, outlines.centres, outlines.intrinsics,
        outlines.projections, sizes, offsets, fields, least, near, far, centre, radius, step_px,
        whole, without, ends, counts,
    )  # fmt: skip
    return Residuals(view, whole, without, ends, counts)


TOLERANCE_PX = 2.0
SLACK_PX = 0.25
"""What sampling alone may leave of a residual."""


class Coherence(NamedTuple):
    """How well a set of views fits together; residuals beyond SLACK_PX, in pixels of the fields."""

    whole: np.ndarray
    """(N,) mean residual of each view's rays against all others; NaN for a view without rays."""
    without: np.ndarray
    """(N, N) the same with view [., j] left out; the diagonal is NaN."""
    beside: np.ndarray
    """(N,) mean residual of rays that pass the mask by: small where the other masks rule out little."""
    beside_without: np.ndarray
    """(N, N) the same with view [., j] left out."""
    contradicted: np.ndarray
    """(N,) share of each view's rays that no point satisfies within TOLERANCE_PX."""
    ball: tuple[np.ndarray, float] | None
    """Where the object seems to be: centre and radius."""

    @property
    def score(self) -> float:
        """Mean residual over all views; CAP_PX when there are no rays."""
        return _mean(self.whole)

    @property
    def power(self) -> float:
        """Mean residual of the rays beside the masks; 0 for views that agree because they say nothing."""
        return _mean(self.beside, 0.0)

    def score_without(self, view: int) -> float:
        """Mean residual of the other views among themselves."""
        return _mean(np.delete(self.without[:, view], view))

    def power_without(self, view: int) -> float:
        """`power` of the other views among themselves."""
        return _mean(np.delete(self.beside_without[:, view], view), 0.0)


def measure_coherence(
    outlines: Outlines, per_view: int = 256, step_px: float = 1.0, *, power: bool = True
) -> Coherence:
    """Marches rays of every mask: first wherever three views see, then round the place found.

    Where three views agree nowhere, two are enough to find the place.

    Args:
        per_view: rays of each mask, and half as many beside it.
        power: False leaves out the rays beside the masks.
    """
    views = len(outlines)
    view, uv = choose_pixels(outlines, per_view)
    ball = None
    for least in range(min(2, views - 1), 0, -1):
        found = march_rays(outlines, view, uv, least=least, step_px=2 * step_px)
        ball = _place(found)
        if ball is not None:
            break
    beside = None
    if ball is not None:
        found = march_rays(outlines, view, uv, least=1, ball=ball, step_px=step_px)
        if power:
            around = choose_pixels(outlines, max(per_view // 2, 8), beside=True)
            beside = march_rays(outlines, *around, least=1, ball=ball, step_px=step_px)
    whole, without, contradicted = _means(found, views)
    return Coherence(whole, without, *_means(beside, views)[:2], contradicted, ball)


def _means(found: Residuals | None, views: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each view's rays: mean residuals (N,), with one view left out (N, N), and share contradicted (N,)."""
    whole, contradicted, without = *np.full((2, views), np.nan), np.full((views, views), np.nan)
    if found is None:
        return whole, without, contradicted
    for i in range(views):
        mine = (found.view == i) & (found.counts | (found.whole <= TOLERANCE_PX))
        if mine.any():
            whole[i] = _excess(found.whole[mine]).mean()
            without[i] = _excess(found.without[mine]).mean(0)
            without[i, i] = np.nan
            contradicted[i] = (found.whole[mine] > TOLERANCE_PX).mean()
    return whole, without, contradicted


def _mean(values: np.ndarray, otherwise: float = CAP_PX) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else otherwise


def _excess(residuals: np.ndarray) -> np.ndarray:
    return np.maximum(residuals - SLACK_PX, 0.0)


def _place(found: Residuals) -> tuple[np.ndarray, float] | None:
    """A ball round most of the points where rays come close to agreement."""
    close = found.whole < 0.5 * CAP_PX
    if close.sum() < 8:
        return None
    ends = found.ends[close]
    centre = np.median(ends.mean(1), 0)
    middles, reach = (np.linalg.norm(p - centre, axis=-1) for p in (ends.mean(1), ends))
    # Views from similar directions leave the depth open: then the ends lie much farther out than the middles.
    return centre, max(1.5 * float(np.quantile(middles, 0.9)), float(np.quantile(reach.max(1), 0.9)))
