"""Where photographs contradict a shape: voxels of its surface that several views show in different colours.

Such a voxel is unlikely to be surface (Kutulakos and Seitz, A Theory of Shape by Space Carving, IJCV 2000). It is
carved away only as far as the silhouettes allow, for the flow gives every ray through a mask its voxel back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.kernels import kernel
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import Grid, Silhouettes
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.point_colours import check_images
from visdom_plugin.hull.queries.raycast import depth_and_silhouette

_SURFACE = 0.4
"""A voxel is near the surface where the blurred shape is within this of one half: about a voxel to either side."""
_SLACK = 2.0
"""Voxels behind the surface that a view shows, in which it still sees a voxel."""


class PhotoConsistency:
    """Photographs of a shape that is being looked for.

    Args:
        cameras: (N,) cameras.
        silhouettes: their masks; colours count where these demand something.
        images: N tensors or arrays (H, W, 3), integers in 0..255 or floats in [0, 1].
        tolerance: standard deviation of a voxel's colours, of 1, at which the views contradict each other by
            1 - 1/e.
    """

    def __init__(self, cameras: Cameras, silhouettes: Silhouettes, images: Sequence, tolerance: float):
        self.cameras, self.silhouettes, self.tolerance = cameras, silhouettes, tolerance
        checked = check_images(images, cameras)
        self.images = [x.float() if x.is_floating_point() else x.float() / 255 for x in checked]

    def contradiction(self, u: np.ndarray, blurred: np.ndarray, level: Grid) -> np.ndarray:
        """How much the photographs speak against each voxel of the surface.

        Args:
            u: (X, Y, Z) float32, the shape; above 0.5 is in.
            blurred: (X, Y, Z) float32, the same blurred.
            level: the grid they are on.

        Returns:
            (X, Y, Z) float32 in [0, 1]; 0 away from the surface and where fewer than two views see a voxel.
        """
        shape, s = Hull(u > 0.5, level.bounds), self.silhouettes
        centre = torch.from_numpy(level.bounds.mean(0))
        colours, depths = [], []
        for i, image in enumerate(self.images):
            camera = self.cameras[i].to("cpu", torch.float64)
            away = float(((centre - camera.centres) * camera.forward).sum())
            image_of_voxel = float(camera.intrinsics[0, 0]) * level.voxel / away if away > 0 else 1.0
            mask = torch.from_numpy(s.mask(i)).float()
            colours.append(_average(image, mask, image_of_voxel).reshape(-1, 3).numpy())
            depths.append(depth_and_silhouette(shape, camera)[0].reshape(-1).numpy())
        found = np.zeros_like(u)
        parallel_for(
            _contradict, u.shape[0] * u.shape[1], 64, blurred, level.lower, level.voxel, s.projections, s.sizes,
            s.offsets, s.pixels, np.concatenate(depths), np.concatenate(colours), self.tolerance, found,
        )  # fmt: skip
        return found


def _average(image: Tensor, mask: Tensor, edge: float) -> Tensor:
    """(H, W, 3) mean colours of the mask's pixels in a square about `edge` pixels wide round each pixel."""
    size = max(round(edge), 1) | 1
    both = torch.cat([image * mask[..., None], mask[..., None]], -1).permute(2, 0, 1)[None]
    mean = torch.nn.functional.avg_pool2d(both, size, 1, size // 2, count_include_pad=False)[0]
    return (mean[:3] / mean[3].clamp_min(1e-3)).permute(1, 2, 0).contiguous()


@kernel()
def _contradict(
    begin: int, end: int, blurred: np.ndarray, lower: np.ndarray, voxel: float, projections: np.ndarray,
    sizes: np.ndarray, offsets: np.ndarray, masks: np.ndarray, depths: np.ndarray, colours: np.ndarray,
    tolerance: float, found: np.ndarray,
) -> None:  # fmt: skip
    """Rows (x, y), flattened."""
    _, ny, nz = blurred.shape
    total = np.empty(3)
    for row in range(begin, end):
        i, j = row // ny, row % ny
        x, y = lower[0] + (i + 0.5) * voxel, lower[1] + (j + 0.5) * voxel
        for k in range(nz):
            if abs(blurred[i, j, k] - 0.5) > _SURFACE:
                continue
            z = lower[2] + (k + 0.5) * voxel
            count, squares = 0, 0.0
            for c in range(3):
                total[c] = 0
            for v in range(len(sizes)):
                p = projections[v]
                depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                if depth <= 0:
                    continue
                column = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth
                line = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth
                if not (0 <= column < sizes[v, 0] and 0 <= line < sizes[v, 1]):
                    continue
                pixel = offsets[v] + int(line) * sizes[v, 0] + int(column)
                if masks[pixel] and depth - depths[pixel] < _SLACK * voxel:
                    count += 1
                    for c in range(3):
                        total[c] += colours[pixel, c]
                        squares += colours[pixel, c] ** 2
            if count >= 2:
                mean = (total[0] ** 2 + total[1] ** 2 + total[2] ** 2) / count
                variance = max(squares - mean, 0.0) / (3 * count)
                found[i, j, k] = 1 - np.exp(-variance / tolerance**2)
