"""The rasteriser on the CPU: numba kernels in two differentiable steps, projection and blending.

The pixel-space means between the two are an ordinary tensor of the graph; its gradient is what densification
looks at. Results repeat to the bit, whatever the number of threads: every sum has a fixed order.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.splat.cpu import blending, projection
from visdom_plugin.splat.cpu.tiles import Tiles
from visdom_plugin.splat.gaussians import Gaussians

GAUSSIANS_PER_PIECE = 1024
TILES_PER_PIECE = 8


def rasterise_cpu(
    gaussians: Gaussians, camera: Cameras, background: Tensor, degree: int, near: float
) -> Render:
    """See `rasterise`. float32 or float64, by the dtype of the means."""
    width, height = camera.size
    packed = _pack(camera, near).to(gaussians.means.dtype).numpy()
    parameters = gaussians.tensors().values()
    means2d, splats, extents, radii = _Project.apply(*parameters, degree, packed, width, height)
    if means2d.requires_grad:
        means2d.retain_grad()
    rgb, alpha, depth = _Blend.apply(means2d, splats, extents, background, width, height)
    info = {
        "means2d": means2d,
        "radii": radii,
        "visible": (radii > 0).all(-1),
        "conics": splats[:, :3].detach(),
        "colours": splats[:, 4:7].detach(),
        "depths": splats[:, 7].detach(),
        "width": width,
        "height": height,
    }
    return Render(rgb, alpha, depth, info)


def warm_up() -> None:
    """Compiles every float32 kernel of a training step, or loads it from numba's cache; later calls are free."""
    from visdom_plugin.ssim import ssim

    eye = torch.eye(4, dtype=torch.float64)
    k = eye.new_tensor([[16, 0, 8], [0, 16, 8], [0, 0, 1]])
    camera = Cameras.from_matrices(k, eye, width=16, height=16)
    shapes = ((1, 3), (1, 3), (1, 4), (1,), (1, 16, 3))
    gaussians = Gaussians(*(torch.ones(shape, requires_grad=True) for shape in shapes))
    render = rasterise_cpu(gaussians, camera, torch.ones(3), 3, 0.01)
    (ssim(render.rgb, torch.zeros(16, 16, 3)) + render.depth.sum()).backward()


def _pack(camera: Cameras, near: float) -> Tensor:
    """(20,) float64, as the projection kernels expect it."""
    motion, k = camera.camera_from_world.double(), camera.intrinsics.double()
    lens = torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
    centre = camera.centres.double()
    parts = [
        motion[:3, :3].reshape(9),
        motion[:3, 3],
        lens,
        centre,
        torch.tensor([near], dtype=torch.float64),
    ]
    return torch.cat([p.cpu() for p in parts])


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [t.detach().contiguous().numpy() for t in tensors]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, log_scales, quaternions, opacity_logits, sh, degree, camera, width, height):
        ctx.save_for_backward(means, log_scales, quaternions, sh)
        arrays = _arrays(means, log_scales, quaternions, opacity_logits, sh)
        n, dtype = len(means), arrays[0].dtype
        means2d, splats, extents = np.empty((n, 2), dtype), np.empty((n, 8), dtype), np.empty((n, 3), dtype)
        radii = np.empty((n, 2), np.int32)
        parallel_for(
            projection.project, n, GAUSSIANS_PER_PIECE, *arrays, degree, camera, width, height,
            means2d, splats, extents, radii,
        )  # fmt: skip
        ctx.rest = (degree, camera, width, height, splats, extents)
        out = [torch.from_numpy(x) for x in (means2d, splats, extents, radii)]
        ctx.mark_non_differentiable(*out[2:])
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means2d, g_splats, *_):
        arrays = _arrays(*ctx.saved_tensors)
        # Written whole by the kernel.
        g_means, g_log_scales, g_quaternions, g_sh = (np.empty_like(x) for x in arrays)
        g_opacity_logits = np.empty(len(g_means), g_means.dtype)
        gradients = (g_means, g_log_scales, g_quaternions, g_opacity_logits, g_sh)
        parallel_for(
            projection.project_backward, len(g_means), GAUSSIANS_PER_PIECE, *arrays, *ctx.rest,
            *_arrays(g_means2d, g_splats), *gradients,
        )  # fmt: skip
        return *(torch.from_numpy(g) for g in gradients), None, None, None, None


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, splats, extents, background, width, height):
        arrays = _arrays(means2d, splats, extents, background)
        tiles = Tiles(*arrays[:3], width, height)
        dtype, size = arrays[0].dtype, (height, width)
        rgb = np.empty((*size, 3), dtype)
        alpha, depth, transmittance = (np.empty(size, dtype) for _ in range(3))
        last = np.empty(size, np.int32)
        parallel_for(
            blending.blend, tiles.count, TILES_PER_PIECE, tiles.starts, tiles.gaussians, tiles.columns, *arrays,
            rgb, alpha, depth, transmittance, last,
        )  # fmt: skip
        out = [torch.from_numpy(x) for x in (rgb, alpha, depth)]
        ctx.save_for_backward(means2d, splats, extents, background, *out[1:])
        ctx.tiles, ctx.transmittance, ctx.last = tiles, transmittance, last
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_rgb, g_alpha, g_depth):
        *inputs, alpha, depth = _arrays(*ctx.saved_tensors)
        tiles, last = ctx.tiles, ctx.last
        outer = _arrays(g_rgb, g_alpha, g_depth)
        drawn_starts = blending.drawn_starts_of(last, tiles.columns, tiles.count)
        sums = np.empty((drawn_starts[-1], blending.SUMS), alpha.dtype)
        parallel_for(
            blending.blend_backward, tiles.count, TILES_PER_PIECE, tiles.starts, tiles.gaussians, tiles.columns,
            *inputs, alpha, depth, ctx.transmittance, last, *outer, drawn_starts, sums,
        )  # fmt: skip
        g_means2d, g_splats = np.empty_like(inputs[0]), np.empty_like(inputs[1])
        parallel_for(
            blending.gather, len(g_means2d), GAUSSIANS_PER_PIECE, tiles.offsets, tiles.slot_tiles,
            tiles.slot_places, tiles.starts, drawn_starts, sums, g_means2d, g_splats,
        )  # fmt: skip
        g_background = None
        if ctx.needs_input_grad[3]:
            g_background = torch.from_numpy((outer[0] * ctx.transmittance[..., None]).sum((0, 1)))
        return torch.from_numpy(g_means2d), torch.from_numpy(g_splats), None, g_background, None, None
