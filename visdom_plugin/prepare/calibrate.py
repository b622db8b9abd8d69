"""Focal length, radial distortion and metric poses from the board's corners in all views together.

One focal length and two radial terms serve all views, the principal point is the image's centre. Corners' errors
are minimised in pixels, with a loss that outliers hardly move; what the views cannot determine stays at its start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.prepare.board import LEAST_CORNERS, Corners

_FOCAL_STARTS = (0.75, 1.0, 1.4, 2.2, 3.5)
"""In long sides of the image, where EXIF says nothing: wide-angle to short telephoto lenses."""
_FOCAL_SURE, _RADIAL_SURE = 0.02, 0.15
"""Standard deviations beyond which a focal length (relative) or a radial term is not determined by the views."""
_OUTLIER_PX = 0.3
_STRAY = 4.0
"""Corners further off than this many standard deviations are taken for misread: shadows, the object's edge."""
_BAD_PX, _BAD_RATIO = 2.0, 4.0
"""A view is bad whose mean error is larger than both, at an image of 1000 pixels, and times the views' median."""


@dataclass(frozen=True)
class BoardView:
    """What the board tells of one photograph."""

    name: str
    corners: int
    rms_px: float | None = None
    """Root mean square reprojection error of the corners, in pixels of the photograph."""
    world_from_camera: np.ndarray | None = None
    """(4, 4) OpenCV axes, in the board's frame, metres; None where the view is left out."""
    reason: str = ""
    """Why it is left out."""


@dataclass(frozen=True)
class BoardCalibration:
    """One lens and the poses of the views that the board could be found in."""

    focal_px: float
    radial: tuple[float, float]
    views: tuple[BoardView, ...]
    """As many as photographs."""
    rms_px: float
    notes: tuple[str, ...] = ()
    """What could not be determined."""
    focal_sigma: float = field(default=0.0)
    """Standard deviation of the focal length, as a share of it."""


def calibrate(
    corners: Sequence[Corners],
    points: np.ndarray,
    sizes: Sequence[tuple[int, int]],
    names: Sequence[str],
    focal_px: float | None,
) -> BoardCalibration:
    """Calibrates the lens and places the cameras.

    Args:
        corners: of each photograph.
        points: (C, 3) the board's corners, metres.
        sizes: width and height of each photograph; sides may be exchanged.
        names: of the photographs.
        focal_px: by EXIF or the user, None where nothing is known.

    Raises:
        SceneError: fewer than two views show enough of the board, or nothing tells the focal length.
    """
    reasons = [_refuse(c, points) for c in corners]
    used = [i for i, reason in enumerate(reasons) if not reason]
    if len(used) < 2:
        raise SceneError(
            f"the board can be used in {len(used)} of {len(corners)} photographs: "
            + list_some((f"{n}: {r}" for n, r in zip(names, reasons, strict=True) if r), 4),
            where=", ".join(names[:3]),
            cause="the object covers the board, or the photographs are blurred or from too flat an angle",
            todo=f"show at least {LEAST_CORNERS} corners in each photograph, the whole board if possible",
            topic="no-board",
        )
    scale = max(sizes[0])
    solver = _Solver([corners[i] for i in used], points, [sizes[i] for i in used])
    notes: list[str] = []
    state = solver.start(focal_px, scale)
    state, sigma = solver.solve(state, ("focal", "k1", "k2"))
    solver, strays = solver.without_strays(state)
    if strays:
        notes.append(f"{strays} corners are left out, which do not fit the others")
        state, sigma = solver.solve(state, ("focal", "k1", "k2"))
    free = ["focal", "k1", "k2"]
    for which, name in ((2, "k2"), (1, "k1")):
        if sigma[which] > _RADIAL_SURE:
            free.remove(name)
            state[which] = 0.0
            notes.append(f"the second radial term is not determined (+- {sigma[which]:.2g}) and stays at 0"
                         if which == 2 else "the first radial term is not determined and stays at 0")  # fmt: skip
            state, sigma = solver.solve(state, free)
    if sigma[0] > _FOCAL_SURE:
        if focal_px is None:
            raise SceneError(
                f"the photographs do not tell the focal length: {math.exp(state[0]):.0f} px +- {sigma[0]:.0%}",
                where=", ".join(names[:3]),
                cause="all look straight down on the board, or show little of it, and the files have no EXIF data",
                todo="add photographs from lower down, or give the focal length with --focal-35mm",
                topic="focal-length",
            )
        notes.append(
            f"the focal length is not determined by the views ({math.exp(state[0]):.0f} px +- {sigma[0]:.0%}) and "
            f"stays at EXIF's {focal_px:.0f} px"
        )
        state[0] = math.log(focal_px)
        free.remove("focal")
        state, sigma = solver.solve(state, free)
    errors = solver.errors(state)
    limit = max(_BAD_PX * scale / 1000, _BAD_RATIO * float(np.median(errors)))
    bad = errors > limit
    if bad.any() and (~bad).sum() >= 2:
        kept = np.flatnonzero(~bad)
        for i in np.flatnonzero(bad):
            reasons[used[i]] = (
                f"the board's corners are {errors[i]:.1f} px off (the others {np.median(errors[kept]):.2f} px): "
                "blurred, bent, or markers misread"
            )
        solver, state = solver.keep(kept), np.concatenate([state[:3], state[3:].reshape(-1, 6)[kept].ravel()])
        used = [used[i] for i in kept]
        state, sigma = solver.solve(state, free)
        errors = solver.errors(state)
    poses = dict(zip(used, zip(errors, solver.poses(state), strict=True), strict=True))
    views = tuple(
        BoardView(
            name,
            len(c.ids),
            float(poses[i][0]) if i in poses else None,
            poses[i][1] if i in poses else None,
            reasons[i],
        )
        for i, (name, c) in enumerate(zip(names, corners, strict=True))
    )
    counts = np.array([len(corners[i].ids) for i in used])
    rms = float(np.sqrt((errors**2 * counts).sum() / counts.sum()))
    return BoardCalibration(
        math.exp(state[0]), (float(state[1]), float(state[2])), views, rms, tuple(notes), float(sigma[0])
    )


def _refuse(corners: Corners, points: np.ndarray) -> str:
    """Why a view cannot be used; empty where it can."""
    if len(corners.ids) == 0:
        return f"no board found ({corners.markers} markers)" if corners.markers else "no board found"
    if len(corners.ids) < LEAST_CORNERS:
        return f"only {len(corners.ids)} corners of the board found, {LEAST_CORNERS} are needed"
    flat = points[corners.ids, :2] - points[corners.ids, :2].mean(0)
    spread = np.linalg.svd(flat, compute_uv=False)
    if spread[1] < 0.15 * spread[0]:
        return "the corners found lie in one line"
    return ""


class _Solver:
    """Least squares over log focal length, k1, k2, and rotation vector and translation of each view.

    Poses are camera from board. The state is one vector (3 + 6 N,).
    """

    def __init__(self, corners: Sequence[Corners], points: np.ndarray, sizes: Sequence[tuple[int, int]]):
        self.sizes = list(sizes)
        self.corners = list(corners)
        self.points = points
        self._ends = np.cumsum([0, *(2 * len(c.ids) for c in corners)])

    def keep(self, which: np.ndarray) -> _Solver:
        """The same for some of the views."""
        return _Solver([self.corners[i] for i in which], self.points, [self.sizes[i] for i in which])

    def without_strays(self, state: np.ndarray) -> tuple[_Solver, int]:
        """The same without corners that do not fit, as far as views keep enough; and how many these are."""
        r = np.hypot(*self._residuals(state)[0].reshape(-1, 2).T)
        # Of two normal errors, the distance has a median of 1.18 standard deviations.
        limit = max(_STRAY * float(np.median(r)) / 1.18, _OUTLIER_PX)
        kept, start = [], 0
        for c in self.corners:
            fine = r[start : start + len(c.ids)] < limit
            start += len(c.ids)
            fine = fine if fine.sum() >= LEAST_CORNERS else np.ones_like(fine)
            kept.append(c._replace(ids=c.ids[fine], uv=c.uv[fine]))
        count = sum(len(a.ids) - len(b.ids) for a, b in zip(self.corners, kept, strict=True))
        return _Solver(kept, self.points, self.sizes), count

    def start(self, focal_px: float | None, scale: int) -> np.ndarray:
        """A state from each view alone; of several focal lengths the one that fits best."""
        guesses = [focal_px] if focal_px else [s * scale for s in _FOCAL_STARTS]
        states = [self._place(f) for f in guesses]
        costs = [np.median(self.errors(s)) for s in states]
        return states[int(np.argmin(costs))]

    def _place(self, focal: float) -> np.ndarray:
        import cv2

        poses = []
        for c, size in zip(self.corners, self.sizes, strict=True):
            found = cv2.solvePnPGeneric(
                self.points[c.ids], c.uv, _matrix(focal, size), None, flags=cv2.SOLVEPNP_IPPE
            )
            # Of the two poses of a plane the one with the smaller error, and the camera above the paper.
            best = min(
                zip(found[1], found[2], np.ravel(found[3]), strict=True),
                key=lambda p: (_height(p[0], p[1]) <= 0, p[2]),
            )
            poses += [*np.ravel(best[0]), *np.ravel(best[1])]
        return np.array([math.log(focal), 0.0, 0.0, *poses])

    def solve(self, state: np.ndarray, free: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """The best state with the lens' other terms fixed, and the standard deviations of the lens' three."""
        from scipy.optimize import least_squares

        mask = np.concatenate([[n in free for n in ("focal", "k1", "k2")], np.ones(len(state) - 3, bool)])
        base = state.copy()

        def full(x: np.ndarray) -> np.ndarray:
            whole = base.copy()
            whole[mask] = x
            return whole

        found = least_squares(
            lambda x: self._residuals(full(x))[0],
            state[mask],
            jac=lambda x: self._residuals(full(x))[1][:, mask],
            loss="soft_l1",
            f_scale=_OUTLIER_PX,
            x_scale="jac",
        )
        residuals, J = self._residuals(full(found.x))
        J = J[:, mask]
        freedom = max(1, len(residuals) - J.shape[1])
        # A noise of a tenth of a pixel at least: a perfect fit of few corners tells nothing of its own accuracy.
        noise = max(0.1, 1.4826 * float(np.median(np.abs(residuals))) * math.sqrt(len(residuals) / freedom))
        covariance = np.linalg.pinv(J.T @ J) * noise**2
        sigma = np.zeros(3)
        sigma[mask[:3]] = np.sqrt(np.diag(covariance)[: int(mask[:3].sum())])
        return full(found.x), sigma

    def _residuals(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(2 M,) pixels and their (2 M, 3 + 6 N) derivatives."""
        import cv2

        focal = math.exp(state[0])
        r, J = np.zeros(self._ends[-1]), np.zeros((self._ends[-1], len(state)))
        for i, (c, size) in enumerate(zip(self.corners, self.sizes, strict=True)):
            rows = slice(self._ends[i], self._ends[i + 1])
            pose = state[3 + 6 * i : 9 + 6 * i]
            bent = np.array([state[1], state[2], 0.0, 0.0])
            uv, d = cv2.projectPoints(self.points[c.ids], pose[:3], pose[3:], _matrix(focal, size), bent)
            r[rows] = (uv.reshape(-1, 2) - c.uv).ravel()
            J[rows, 3 + 6 * i : 9 + 6 * i] = d[:, :6]
            J[rows, 0] = (d[:, 6] + d[:, 7]) * focal
            J[rows, 1:3] = d[:, 10:12]
        return r, J

    def errors(self, state: np.ndarray) -> np.ndarray:
        """(N,) root mean square error of each view, pixels."""
        r = self._residuals(state)[0]
        return np.array([
            math.sqrt(2 * float((r[a:b] ** 2).mean()))
            for a, b in zip(self._ends[:-1], self._ends[1:], strict=True)
        ])  # fmt: skip

    def poses(self, state: np.ndarray) -> list[np.ndarray]:
        """World-from-camera matrices (4, 4)."""
        found = []
        for pose in state[3:].reshape(-1, 6):
            matrix = np.eye(4)
            rotation = _rotation(pose[:3])
            matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ pose[3:]
            found.append(matrix)
        return found


def _matrix(focal: float, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics with our pixels' origin at the image's corner, which is all the same to a projection."""
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])


def _rotation(vector: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(np.asarray(vector, np.float64).reshape(3, 1))[0]


def _height(vector: np.ndarray, translation: np.ndarray) -> float:
    """Of the camera above the board's plane."""
    return float((-_rotation(vector).T @ np.ravel(translation))[2])
