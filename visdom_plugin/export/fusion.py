"""Fuses rendered depth into a surface: a truncated signed distance on a grid (Curless and Levoy 1996).

Any renderer will do. For Gaussians, which have no surface of their own, this is where their mesh comes from.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.compute.waiting import counting
from visdom_plugin.export.meshes import Mesh
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras

if TYPE_CHECKING:
    from torch import Tensor

    from visdom_plugin.training.evaluate import Renderer

RESOLUTION, VIEWS, PICTURE_PX = 160, 32, 200
"""Voxels along the longest side; pictures taken all round, and their width and height."""
TRUNCATION = 3.0
"""Voxels in front of and behind a surface over which its distance is kept."""
BEHIND = 0.1
"""Weight of a view that has something in front of a voxel. Without it, one view that sees through a gap in a
surface digs a hole into what all others find solid."""


def surround(cameras: Cameras, centre: Tensor, count: int, size_px: int) -> Cameras:
    """Cameras evenly over the sphere round an object, at the capture's mean distance, that see as much of it.

    Args:
        cameras: (N,) cameras of the capture.
        centre: (3,) of the object.
        size_px: width and height of their square images.

    Returns:
        (count,) cameras, float64.
    """
    cameras = cameras.to("cpu", torch.float64)
    centre = centre.to(cameras.centres)
    distance = (cameras.centres - centre).norm(dim=-1).mean()
    turn = torch.arange(count, dtype=torch.float64)
    # A Fibonacci lattice.
    z = 1 - (2 * turn + 1) / count
    angle = turn * math.pi * (3 - math.sqrt(5))
    flat = (1 - z * z).sqrt()
    at = centre + distance * torch.stack([flat * angle.cos(), flat * angle.sin(), z], -1)
    motion = look_at_camera(at, centre.expand_as(at), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    size = torch.stack([cameras.width, cameras.height], -1)
    narrow = (size / cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]).amin(-1)
    focal = size_px / float(narrow.mean())
    K = torch.tensor([[focal, 0, size_px / 2], [0, focal, size_px / 2], [0, 0, 1]], dtype=torch.float64)
    side = torch.full((count,), size_px)
    return Cameras(K.expand(count, 3, 3), motion, side, side)


@kernel()
def _integrate(
    begin: int, end: int, total: np.ndarray, weight: np.ndarray, colour: np.ndarray, near: np.ndarray,
    inside: np.ndarray, lower: np.ndarray, edge: float, view: np.ndarray, K: np.ndarray, depth: np.ndarray,
    alpha: np.ndarray, rgb: np.ndarray, truncation: float, behind: float,
) -> None:  # fmt: skip
    """Adds one view to the planes `begin` to `end` of a grid.

    Args:
        total, weight: (X, Y, Z) float32 sums of the truncated distance, 1 in front and -1 behind, and of weights.
        colour, near: (X, Y, Z, 3) and (X, Y, Z) float32 sums of colours near the surface, and of their weights.
        inside: (X, Y, Z) uint8, other voxels are left alone.
        lower, edge: place of the grid.
        view: (3, 4) camera from world; K: (3, 3).
        depth, alpha, rgb: (H, W), (H, W), (H, W, 3) float32.
        truncation: scene units.
        behind: see `BEHIND`.
    """
    _nx, ny, nz = total.shape
    height, width = depth.shape
    for i in range(begin, end):
        x = lower[0] + (i + 0.5) * edge
        for j in range(ny):
            y = lower[1] + (j + 0.5) * edge
            for k in range(nz):
                if inside[i, j, k] == 0:
                    continue
                z = lower[2] + (k + 0.5) * edge
                cz = view[2, 0] * x + view[2, 1] * y + view[2, 2] * z + view[2, 3]
                if cz <= 0:
                    continue
                cx = view[0, 0] * x + view[0, 1] * y + view[0, 2] * z + view[0, 3]
                cy = view[1, 0] * x + view[1, 1] * y + view[1, 2] * z + view[1, 3]
                u = math.floor(K[0, 0] * cx / cz + K[0, 2])
                v = math.floor(K[1, 1] * cy / cz + K[1, 2])
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                if alpha[v, u] < 0.5:
                    total[i, j, k] += 1.0
                    weight[i, j, k] += 1.0
                    continue
                distance = (depth[v, u] - cz) / truncation
                if distance < -1:
                    total[i, j, k] -= behind
                    weight[i, j, k] += behind
                    continue
                total[i, j, k] += min(distance, 1.0)
                weight[i, j, k] += 1.0
                if distance < 1:
                    share = 1.0 - abs(distance)
                    near[i, j, k] += share
                    for c in range(3):
                        colour[i, j, k, c] += share * rgb[v, u, c]


class Volume:
    """A truncated signed distance on a grid, negative inside.

    Args:
        bounds: (2, 3) box, scene units.
        resolution: voxels along its longest side.
        inside: points (n, 3) float64 to (n,) bool, where a surface may be; None for everywhere.
    """

    def __init__(self, bounds: np.ndarray, resolution: int, inside: Callable[[Tensor], Tensor] | None = None):
        bounds = np.asarray(bounds, np.float64)
        self.edge = float((bounds[1] - bounds[0]).max()) / resolution
        # Two voxels of air all round, so that the surface closes.
        self.lower = bounds[0] - 2 * self.edge
        shape = tuple(int(n) + 4 for n in np.ceil((bounds[1] - bounds[0]) / self.edge))
        self._total, self._weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._colour, self._near = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        self.inside = (
            np.ones(shape, bool) if inside is None else inside(self._centres()).numpy().reshape(shape)
        )

    def _centres(self) -> Tensor:
        axes = [
            torch.as_tensor(self.lower[a] + self.edge * (np.arange(n) + 0.5))
            for a, n in enumerate(self._total.shape)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def add(self, camera: Cameras, depth: np.ndarray, alpha: np.ndarray, rgb: np.ndarray) -> None:
        """Takes one view in.

        Args:
            camera: one camera, shape ().
            depth: (H, W) along the camera's z axis, scene units.
            alpha: (H, W) opacity; where it is less than half the view is taken to see past the object.
            rgb: (H, W, 3) colour of the object itself, without background.
        """
        camera = camera.to("cpu", torch.float64)
        parallel_for(
            _integrate, len(self._total), 4, self._total, self._weight, self._colour, self._near,
            self.inside.view(np.uint8), self.lower, self.edge,
            np.ascontiguousarray(camera.camera_from_world[:3].numpy()),
            np.ascontiguousarray(camera.intrinsics.numpy()),
            *(np.ascontiguousarray(a, np.float32) for a in (depth, alpha, rgb)), TRUNCATION * self.edge, BEHIND,
        )  # fmt: skip

    def surface(self) -> Mesh | None:
        """The zero level by marching cubes; None where there is none.

        Voxels that every view has something in front of are inside.
        """
        from scipy.ndimage import distance_transform_edt, map_coordinates
        from skimage.measure import marching_cubes

        distance = np.where(self._weight > 0, self._total / np.maximum(self._weight, 1), -1)
        distance = np.where(self.inside, distance, 1)
        if not (distance < 0).any():
            return None
        vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
        seen = self._near > 0
        colour = self._colour / np.maximum(self._near, 1e-9)[..., None]
        nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
        colour = colour[tuple(nearest)]
        rgb = np.stack(
            [map_coordinates(colour[..., c], vertices.T, order=1, mode="nearest") for c in range(3)], -1
        )
        world = self.lower + self.edge * (vertices + 0.5)
        return Mesh(world, faces.astype(np.int64), (rgb.clip(0, 1) * 255).round().astype(np.uint8))


def fuse(
    renderer: Renderer,
    cameras: Cameras,
    bounds: np.ndarray,
    *,
    resolution: int = RESOLUTION,
    inside: Callable[[Tensor], Tensor] | None = None,
    device: torch.device | str = "cpu",
) -> Mesh | None:
    """The surface of what a renderer draws, see `Volume`.

    It is looked at from the capture's cameras and from `VIEWS` more that surround it.

    Args:
        renderer: a trained method, or Gaussians.
        cameras: (N,) cameras of the capture, world frame.
        bounds: (2, 3) box around the object, world frame.
    """
    volume = Volume(bounds, resolution, inside)
    around = surround(cameras, torch.as_tensor(np.asarray(bounds).mean(0)), VIEWS, PICTURE_PX)
    black = torch.zeros(3, device=device)
    looked_from = [*(cameras[i] for i in range(len(cameras))), *(around[i] for i in range(VIEWS))]
    with counting("fusing depth from all round", len(looked_from)) as count:
        for camera in looked_from:
            with torch.no_grad():
                render = renderer.render(camera.to(device), black)
            alpha = render.alpha.float().cpu().numpy()
            rgb = render.rgb.float().cpu().numpy() / np.maximum(alpha, 1e-3)[..., None]
            volume.add(camera, render.depth.float().cpu().numpy(), alpha, rgb)
            count(camera)
    return volume.surface()
