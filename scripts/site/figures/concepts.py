"""Figures of docs/concepts.md, drawn from the built-in scene with the code that trains on it.

python scripts/site/figures/concepts.py [--out DIR]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from before_after import PICTURES, pixels_of, write_webp
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from trimesh import Trimesh
from trimesh.intersections import mesh_plane

from datamodules import load
from visdom_plugin import Cameras, Hull, Scene, VisDomGaussianRegularizer, VisDomSampler, VisibleDomain
from visdom_plugin.figures.canvas import drawing
from visdom_plugin.geometry.cameras import project
from visdom_plugin.hull.inside.shape import shape_inside
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise

MAKES = tuple(f"concept_{name}.webp" for name in ("visual_hull", "k", "band", "outside_loss", "inner_shape"))
HULL, INNER, TRUTH, BAND = "#7aa6d8", "#2b6cb0", "#c53030", "#dd9b1f"
DOMAIN, RIM = "#d6d6d6", "#808080"


class Plane:
    """A window of a plane, with points at even steps."""

    def __init__(
        self, origin: np.ndarray, right: np.ndarray, up: np.ndarray, window: tuple[float, ...], step: float
    ):
        """
        Args:
            origin, right, up: (3,) a point of the plane and two unit vectors in it, at right angles.
            window: left, right, lower and upper edge about the origin.
        """
        self.origin, self.right, self.up, self.window = origin, right, up, window
        a, b = (np.arange(low, high, step) + step / 2 for low, high in (window[:2], window[2:]))
        self.points = origin + a[None, :, None] * right + b[:, None, None] * up
        """(rows, columns, 3), the lowest row first."""

    def flat(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) coordinates in the plane of points (..., 3), dropped onto it."""
        return np.stack([(points - self.origin) @ self.right, (points - self.origin) @ self.up], -1)

    def show(self, axes: Axes, values: np.ndarray, **how) -> None:
        """Draws one value per point."""
        axes.imshow(values, origin="lower", extent=self.window, interpolation="nearest", **how)

    def fill(self, axes: Axes, inside: np.ndarray, colour: str, alpha: float = 1.0) -> None:
        """Draws the points that are inside in one colour."""
        rgba = np.zeros((*inside.shape, 4))
        rgba[..., :3], rgba[..., 3] = to_rgb(colour), alpha * inside
        self.show(axes, rgba)

    def outline(self, axes: Axes, mesh: Trimesh, colour: str = TRUTH) -> None:
        """Draws where a mesh cuts the plane."""
        cut = mesh_plane(mesh, np.cross(self.right, self.up), self.origin)
        for ends in self.flat(cut):
            axes.plot(*ends.T, color=colour, linewidth=1.2)


def main() -> None:
    """Draws all figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=PICTURES)
    args = parser.parse_args()
    scene = load(None, views=4)
    hulls = {k: VisibleDomain(k=k).carve(*scene.train.silhouettes()) for k in (1, 2, 3, 4)}
    with drawing():
        figures = (
            draw_visual_hull(scene),
            draw_k(scene),
            draw_band(scene, hulls[3]),
            draw_outside_loss(scene, hulls[3]),
            draw_inner_shape(scene, hulls[3]),
        )
        for name, figure in zip(MAKES, figures, strict=True):
            write_webp(pixels_of(figure), args.out / name, quality=80)


def level_plane(scene: Scene, half: float, step: float) -> Plane:
    """A level plane through the body of the can, below its spout's tip."""
    mesh = mesh_of(scene)
    low, high = mesh.bounds
    middle = (low + high) / 2
    middle[2] = low[2] + 0.32 * (high[2] - low[2])
    return Plane(middle, np.eye(3)[0], np.eye(3)[1], (-half, half, -half, half), step)


def upright_plane(scene: Scene, step: float) -> Plane:
    """The upright plane through spout and handle: the one in which the can is longest."""
    mesh = mesh_of(scene)
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].mean(0)
    along = np.append(np.linalg.svd(flat, full_matrices=False)[2][0], 0)
    middle = mesh.bounds.mean(0)
    reach = 0.54 * np.ptp(mesh.vertices @ along), 0.55 * np.ptp(mesh.vertices[:, 2])
    middle += along * (
        np.mean([(mesh.vertices @ along).min(), (mesh.vertices @ along).max()]) - middle @ along
    )
    return Plane(middle, along, np.eye(3)[2], (-reach[0], reach[0], -1.25 * reach[1], reach[1]), step)


def mesh_of(scene: Scene) -> Trimesh:
    """The true surface."""
    vertices, faces = scene.mesh
    return Trimesh(vertices.numpy(), faces.numpy(), process=False)


def seen_and_masked(cameras: Cameras, masks, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, ...) bool each: whether a camera sees a point, and whether it sees it inside its mask."""
    uv, depth = project(cameras, torch.from_numpy(points.reshape(-1, 3)))
    size = torch.stack([cameras.width, cameras.height], -1)[:, None]
    seen = (depth > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)
    inside = torch.zeros_like(seen)
    for i, mask in enumerate(masks):
        at = uv[i][seen[i]].long()
        inside[i, seen[i]] = mask[at[:, 1], at[:, 0]]
    shape = (len(cameras), *points.shape[:-1])
    return seen.numpy().reshape(shape), inside.numpy().reshape(shape)


def panels(count: int, size: float, tall: float | None = None, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Rows of panels without axes, the top row first; square panels unless `tall` is given, in inches."""
    tall, title = size if tall is None else tall, 0.32
    figure = Figure((count * size, rows * tall + title), dpi=110, facecolor="white")
    wide, high = 1 / count, tall / (rows * tall + title)
    axes = [
        figure.add_axes((i * wide + 0.005, row * high + 0.01, wide - 0.01, high - 0.01))
        for row in reversed(range(rows))
        for i in range(count)
    ]
    for a in axes:
        a.set_xticks([])
        a.set_yticks([])
        for side in a.spines.values():
            side.set_color("#a0aec0")
    return figure, axes


def mark_cameras(axes: Axes, plane: Plane, cameras: Cameras) -> None:
    """Dots where the cameras stand, dropped onto the plane, with a stroke to where they look."""
    for i, (centre, forward) in enumerate(zip(cameras.centres.numpy(), cameras.forward.numpy(), strict=True)):
        at, ahead = plane.flat(centre), plane.flat(centre + 0.5 * forward)
        axes.plot(*np.stack([at, ahead]).T, color="black", linewidth=1.2)
        axes.plot(*at, "o", color="black", markersize=6)
        axes.annotate(str(i + 1), at, xytext=(7, 4), textcoords="offset points")
    axes.set(xlim=plane.window[:2], ylim=plane.window[2:])


def draw_visual_hull(scene: Scene) -> Figure:
    """A level cut: what one, two and four masks leave."""
    plane = level_plane(scene, 4.7, 0.02)
    _, masked = seen_and_masked(scene.train.cameras, scene.train.masks, plane.points)
    figure, axes = panels(3, 3.8)
    for a, count in zip(axes, (1, 2, 4), strict=True):
        left = masked[:count].all(0)
        for i in range(count):
            plane.fill(a, masked[i], HULL, 0.18)
        plane.fill(a, left, HULL)
        plane.outline(a, mesh_of(scene))
        mark_cameras(a, plane, scene.train.cameras[:count])
        a.set_title(f"{count} mask{'s' if count > 1 else ''}", size=12)
    return figure


def draw_k(scene: Scene) -> Figure:
    """A level and an upright cut with K = 1 to 4: what K cameras see, and what is kept of it."""
    level = level_plane(scene, 4.7, 0.02)
    # Across the spout, where two cameras alone agree on something beside the can.
    upright = Plane(np.array([1.97, -1.1, 0.5]), np.eye(3)[1], np.eye(3)[2], (-2.4, 2.4, -2.4, 2.4), 0.01)
    figure, axes = panels(4, 3.2, rows=2)
    for row, plane in enumerate((level, upright)):
        seen, masked = seen_and_masked(scene.train.cameras, scene.train.masks, plane.points)
        for k in (1, 2, 3, 4):
            a, domain = axes[4 * row + k - 1], seen.sum(0) >= k
            plane.fill(a, domain, DOMAIN)
            a.contour(*plane.flat(plane.points).transpose(2, 0, 1), domain, [0.5], colors=RIM, linewidths=0.8)
            plane.fill(a, domain & (masked | ~seen).all(0), INNER)
            plane.outline(a, mesh_of(scene))
            if plane is level:
                mark_cameras(a, plane, scene.train.cameras)
                a.set_title(f"K = {k}", size=12)
    return figure


def draw_band(scene: Scene, hull: Hull) -> Figure:
    """A cut along one ray: where samples are taken without the hull, from its first hit, from entry to exit."""
    camera = scene.train.cameras[0]
    mesh = mesh_of(scene)
    origin = camera.centres.numpy()
    target = mesh.bounds.mean(0) - np.array([0, 0, 0.25])
    along = (target - origin) / np.linalg.norm(target - origin)
    up = np.array([0, 0, 1.0]) - along[2] * along
    up /= np.linalg.norm(up)
    length = float(np.linalg.norm(target - origin))
    plane = Plane(origin, along, up, (-0.2, 1.75 * length, -0.26 * length, 0.26 * length), 0.01)
    inside = hull.contains(plane.points.reshape(-1, 3)).reshape(plane.points.shape[:2])
    rays = torch.from_numpy(origin)[None], torch.from_numpy(along)[None]
    paper = {"interval": "first_hit", "epsilon_camera_distances": 0.2}
    settings = {"whole ray": None, "first hit (the paper)": paper, "entry to exit (here)": {}}
    figure = Figure((8.2, 7.4), dpi=110, facecolor="white")
    for i, (name, own) in enumerate(settings.items()):
        axes = figure.add_axes((0.005, 0.67 - 0.33 * i, 0.99, 0.3))
        axes.set_axis_off()
        plane.fill(axes, inside, HULL)
        plane.outline(axes, mesh)
        axes.plot(0, 0, "o", color="black", markersize=7)
        begin, end = 0.05, 1.72 * length
        if own is not None:
            near, far, _ = VisDomSampler(hull, cameras=scene.train.cameras, **own)(*rays, begin, end)
            axes.plot((begin, end), (0, 0), color="#718096", linewidth=0.8)
            begin, end = float(near), float(far)
        axes.plot((begin, end), (0, 0), color=BAND, linewidth=2.5)
        t = np.linspace(begin, end, 16)
        axes.plot(t, 0 * t, "o", color=BAND, markersize=5, markeredgecolor="white", markeredgewidth=0.6)
        axes.text(0, 0.19 * length, name, size=12)
    return figure


def draw_outside_loss(scene: Scene, hull: Hull) -> Figure:
    """A view between two cameras: the hull's mask, opacity of Gaussians with strays, and what L_i penalises."""
    hook = VisDomGaussianRegularizer(hull, scene.train.cameras, images=scene.train.images)
    draw = torch.Generator().manual_seed(6)
    xyz, rgb = hook.initial_points(6000, draw)
    middle = torch.as_tensor(hull.centre, dtype=torch.float32)
    strays = middle + torch.randn(40, 3, generator=draw) * 1.3
    xyz, rgb = torch.cat([xyz, strays]), torch.cat([rgb, torch.rand(40, 3, generator=draw)])
    scale = torch.full((len(xyz), 3), float(np.log(0.03)))
    scale[-40:] = float(np.log(0.11))
    upright, opaque = torch.tensor([1.0, 0, 0, 0]).repeat(len(xyz), 1), torch.full((len(xyz),), 1.5)
    gaussians = Gaussians(xyz, scale, upright, opaque, ((rgb - 0.5) / 0.28209479)[:, None])
    camera = hook.sample_camera(draw)
    mask = depth_and_silhouette(hull, camera)[1].numpy()
    seen = rasterise(gaussians, camera, background=torch.ones(3))
    alpha = seen.alpha.detach().numpy()
    penalty = -(1 - mask) * np.log(1 - alpha.clip(0, 0.999))
    figure, axes = panels(4, 3.2)
    grey = {"cmap": "gray_r", "vmin": 0, "vmax": 1}
    for a, (title, picture, how) in zip(axes, (
        ("a view that nobody photographed", seen.rgb.detach().numpy().clip(0, 1), {}),
        ("M, the hull", mask, grey),
        ("A, opacity", alpha, grey),
        ("what L_i penalises", penalty, {"cmap": "Reds", "vmin": 0, "vmax": 2}),
    ), strict=True):  # fmt: skip
        a.imshow(picture, interpolation="nearest", **how)
        a.set_title(title, size=12)
    return figure


def draw_inner_shape(scene: Scene, hull: Hull) -> Figure:
    """An upright cut: hull, shape inside it and truth, from 4 and 9 photographs."""
    plane = upright_plane(scene, 0.006)
    left, right, low, high = plane.window
    figure, axes = panels(2, 5.4, 5.4 * (high - low) / (right - left))
    for a, count in zip(axes, (4, 9), strict=True):
        views = load(None, views=count, test=False).train
        domain = hull if count == 4 else VisibleDomain(k=3).carve(*views.silhouettes())
        inner = shape_inside(domain, *views.silhouettes())
        for shape, colour in ((domain, HULL), (inner, INNER)):
            plane.fill(a, shape.contains(plane.points.reshape(-1, 3)).reshape(plane.points.shape[:2]), colour)
        plane.outline(a, mesh_of(scene))
        for line, (word, colour) in enumerate((("hull", HULL), ("shape inside it", INNER), ("truth", TRUTH))):
            a.text(
                0.02, 0.95 - 0.06 * line, word, color=colour, size=12, transform=a.transAxes, weight="bold"
            )
        a.set_title(f"{count} photographs", size=12)
    return figure


if __name__ == "__main__":
    main()
