"""What all radiance fields share: rays in the field's frame, images from rays, a mesh from density."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from visdom_plugin.compute.waiting import describe_parts, showing
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.geometry.mesh_files import mesh_ply
from visdom_plugin.geometry.pixel_rays import rays_of_pixels
from visdom_plugin.hooks.protocols import PixelSampler, SamplerHook
from visdom_plugin.losses import composite_target, mask_loss
from visdom_plugin.nerf.frame import Frame
from visdom_plugin.nerf.rendering.ray_losses import Photographed
from visdom_plugin.render import Render
from visdom_plugin.training.protocols import PixelBatch

log = logging.getLogger(__name__)


SPEAK_AFTER = 5.0
"""Seconds after which the screen shows how far a view is that takes as long again."""
MESH_RESOLUTION = 160
"""Voxels along the longest side of what `mesh_density` looks at."""


class FieldMesh(NamedTuple):
    """A field's surface."""

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """(F, 3) int64, outward."""
    rgb: np.ndarray
    """(V, 3) uint8 as seen from outside along the normal."""


class LocalRays(NamedTuple):
    """Rays in the field's frame, with the bounds of their samples."""

    origins: Tensor
    """(n, 3) float32."""
    directions: Tensor
    """(n, 3) float32, unit."""
    near: Tensor
    """(n,)."""
    far: Tensor
    """(n,)."""
    hit: Tensor
    """(n,) bool: the visible-domain hook found the hull; True for all without one."""


def bound_rays(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    frame: Frame,
    hooks: Sequence[SamplerHook],
    pixels: Tensor | None = None,
) -> LocalRays:
    """Rays in the field's frame, bounded by every hook in turn.

    Args:
        origins, directions: (n, 3) world frame; directions unit.
        near, far: (n,) the method's own bounds, in the field's frame.
        hooks: they see the world frame.
        pixels: (n,) numbers of training pixels, see `PixelBatch`; None for other rays.
    """
    hit = torch.ones_like(near, dtype=torch.bool)
    if hooks:
        near, far = near / frame.scale, far / frame.scale
        for hook in hooks:
            if pixels is not None and isinstance(hook, PixelSampler):
                near, far, met = hook.bound_pixels(pixels, origins, directions, near, far)
            else:
                near, far, met = hook.bound(origins, directions, near, far)
            hit = hit & met
        near, far = near * frame.scale, far * frame.scale
    return LocalRays(frame.to_local(origins), directions.float(), near.float(), far.float(), hit)


MOST_PIXELS = 1 << 26
"""Training pixels whose bounds are kept: 600 MB."""
PIXELS_AT_ONCE = 1 << 18


class PixelBounds:
    """Bounds of the rays of all training pixels, found at the first question and kept: 9 bytes per pixel.

    Args:
        cameras: (N,) the training cameras.
        bound: origins and directions (n, 3) in the world frame to rays with their bounds.
    """

    def __init__(self, cameras: Cameras, bound: Callable[[Tensor, Tensor], LocalRays]):
        self.cameras, self.bound = cameras, bound
        self.found: list[Tensor] | None = None

    def of(self, pixels: Tensor) -> list[Tensor]:
        """Near, far and hit (n,) of pixels (n,), see `PixelBatch`."""
        if self.found is None:
            sizes = self.cameras.width * self.cameras.height
            ends = sizes.cumsum(0)
            parts = []
            for flat in torch.arange(int(ends[-1]), device=ends.device).split(PIXELS_AT_ONCE):
                view = torch.searchsorted(ends, flat, right=True)
                rays = rays_of_pixels(self.cameras, view, flat - (ends - sizes)[view])
                parts.append(self.bound(*rays)[2:])
            self.found = [torch.cat(x) for x in zip(*parts, strict=True)]
        return [x.index_select(0, pixels) for x in self.found]


def spread_rays(camera: Cameras, most: int = 256) -> tuple[Tensor, Tensor]:
    """Origins and directions (n, 3) of a camera's pixels, at most `most` evenly chosen along each side."""
    width, height = camera.size
    device = camera.intrinsics.device
    v, u = (
        torch.linspace(0.5, size - 0.5, min(size, most), dtype=torch.float64, device=device)
        for size in (height, width)
    )
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    return rays_of(camera.to(dtype=torch.float64), grid)


def photographed(batch: PixelBatch) -> Photographed:
    """What `ray_losses` compares rays with."""
    return Photographed(batch.rgb, batch.mask, batch.mask_known)


def photograph_on(background: Tensor, batch: PixelBatch, alpha: Tensor) -> Tensor:
    """What a batch of pixels should look like on `background` (n, 3); see `losses.composite_target`."""
    return composite_target(batch.rgb, batch.mask, background, alpha=alpha, mask_known=batch.mask_known)


def psnr_of(error: Tensor) -> Tensor:
    """PSNR in dB of colours that are off by `error` (n, 3), a scalar without gradient, at most 100."""
    return -10 * error.detach().square().mean().clamp_min(1e-10).log10()


def silhouette_loss(alpha: Tensor, batch: PixelBatch) -> Tensor:
    """Binary cross entropy between opacity (n,) and mask, over the pixels whose mask is known."""
    return mask_loss(alpha, batch.mask, None if batch.mask_known is None else batch.mask_known.float())


def render_image(
    camera: Cameras,
    render_rays: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]],
    frame: Frame,
    chunk: int,
) -> Render:
    """One view, without gradients.

    Args:
        camera: one camera, shape ().
        render_rays: origins and directions (n, 3), world frame, to colour (n, 3) over the background, opacity
            (n,), and depth (n,) along the ray in the field's frame.
        chunk: rays at a time. Memory beside the result is that of one chunk, whatever the size of the image.
    """
    camera = camera.to(dtype=torch.float64)
    width, height = camera.size
    device = camera.intrinsics.device
    rgb, alpha, depth = (torch.empty(width * height, *tail, device=device) for tail in ((3,), (), ()))
    firsts = range(0, width * height, chunk)
    began, done, said = time.monotonic(), 0, False

    def how_far() -> str:
        took = time.monotonic() - began
        return describe_parts(f"drawing a view of {width} x {height} pixels", done, len(firsts), took)

    with ExitStack() as shown:
        for first in firsts:
            pixels = torch.arange(first, min(first + chunk, width * height), device=device)
            uv = torch.stack([pixels % width, pixels // width], -1).to(camera.intrinsics) + 0.5
            origins, directions = rays_of(camera, uv)
            with torch.no_grad():
                colour, opacity, distance = render_rays(origins, directions)
            along = (directions @ camera.forward).float()
            part = slice(first, first + len(pixels))
            rgb[part], alpha[part] = colour, opacity
            depth[part] = torch.where(opacity > 0, distance * along / frame.scale, 0)
            done += 1
            spent = time.monotonic() - began
            left = spent / done * (len(firsts) - done)
            if not said and spent > SPEAK_AFTER and left > SPEAK_AFTER:
                said = True
                shown.enter_context(showing(how_far))
    shape = (height, width)
    return Render(rgb.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape))


def mesh_density(
    density_of: Callable[[Tensor], Tensor],
    colour_of: Callable[[Tensor, Tensor], Tensor],
    frame: Frame,
    half_side: float,
    *,
    resolution: int = MESH_RESOLUTION,
    origin: Tensor | None = None,
    smallest_piece: float = 0.01,
    chunk: int = 1 << 17,
) -> FieldMesh | None:
    """The outer surface where the field is half opaque over a thirtieth of the object, by marching cubes.

    Whatever the resolution, the level is the same. A coarse look at the whole cube finds the object's box.

    Args:
        density_of: points (m, 3) in the field's frame to density (m,) per unit of that frame.
        colour_of: points and viewing directions (m, 3) to rgb (m, 3) in [0, 1].
        half_side: of the cube around the frame's origin.
        resolution: voxels along the longest side of the box.
        origin: (3,) of the world frame in the capture's, see `Views.origin`; None for the same frame.
        smallest_piece: pieces with fewer voxels than this share of the largest one are left out.

    Returns:
        The mesh in the capture's frame; None where nothing is opaque.
    """
    from scipy.ndimage import binary_fill_holes, label
    from skimage.measure import marching_cubes
    from trimesh import Trimesh

    def sample(lower: np.ndarray, step: float, shape: Sequence[int]) -> np.ndarray:
        axes = [torch.from_numpy(lower[a] + step * (np.arange(shape[a]) + 0.5)).float() for a in range(3)]
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        with torch.no_grad():
            parts = [density_of(points[i : i + chunk]).cpu() for i in range(0, len(points), chunk)]
        return torch.cat(parts).reshape(*shape).numpy()

    def main_pieces(opaque: np.ndarray) -> np.ndarray:
        pieces, count = label(opaque)
        sizes = np.bincount(pieces.ravel(), minlength=count + 1)
        sizes[0] = 0
        return (sizes >= smallest_piece * sizes.max(initial=1))[pieces]

    step = 2 * half_side / 64
    # exp(-density * length) = 1/2; coarse cells may hold thin parts, so less is asked of them.
    coarse = sample(np.full(3, -half_side), step, (64,) * 3) > 0.25 * math.log(2) / step
    opaque = np.argwhere(main_pieces(coarse) & coarse)
    if not len(opaque):
        return None
    lower = -half_side + step * (opaque.min(0) - 1)
    upper = -half_side + step * (opaque.max(0) + 2)
    extent = float((upper - lower).max())
    step = extent / resolution
    values = sample(lower, step, np.ceil((upper - lower) / step).astype(int))
    level = math.log(2) / (extent / 30)
    small = (values > level) & ~main_pieces(values > level)
    values = np.where(small, 0, values)
    # Hollows that nobody can look into have no surface.
    solid = values > level
    values = np.where(binary_fill_holes(solid) & ~solid, values.max(), values)
    values = np.pad(values, 1)
    if not values.max() > level:
        return None
    # The logarithm of an exponential field is close to linear between voxels. Skimage's "ascent" faces outwards.
    vertices, faces, _, _ = marching_cubes(
        np.log(values + 1e-6), math.log(level), gradient_direction="ascent"
    )
    local = lower + step * (vertices - 0.5)
    outward = Trimesh(local, faces, process=False).vertex_normals
    points, inward = torch.from_numpy(local).float(), torch.from_numpy(-outward).float()
    with torch.no_grad():
        parts = [
            colour_of(points[i : i + chunk], inward[i : i + chunk]).cpu()
            for i in range(0, len(points), chunk)
        ]
    rgb = (torch.cat(parts).clamp(0, 1) * 255).round().byte().numpy()
    world = frame.to_world(torch.from_numpy(local)).numpy()
    return FieldMesh(world if origin is None else world + origin.numpy(), faces.astype(np.int64), rgb)


def export_mesh(path: Path, mesh: FieldMesh | None) -> list[Path]:
    """Writes the mesh as PLY with vertex colours; warns where there is none."""
    if mesh is None:
        log.warning("no mesh is exported: nowhere is the field half opaque")
        return []
    path.write_bytes(mesh_ply(*mesh))
    return [path]
