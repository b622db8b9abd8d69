"""The rasteriser on the CPU: numba kernels in two differentiable steps, projection and blending.

The pixel-space means between the two are an ordinary tensor of the graph; its gradient is what densification
looks at. Results repeat to the bit, whatever the number of threads: every sum has a fixed order.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.compute.lanes import WIDTH
from visdom_plugin.compute.parallel import parallel_for
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.splat.cpu import blending, projection
from visdom_plugin.splat.cpu.tiles import Tiles
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.optimiser import GaussianOptimiser

GAUSSIANS_PER_PIECE = 1024
TILES_PER_PIECE = 8


def rasterise_cpu(
    gaussians: Gaussians, camera: Cameras, background: Tensor, degree: int, near: float
) -> Render:
    """See `rasterise`. float32 or float64, by the dtype of the means."""
    width, height = camera.size
    parameters = gaussians.tensors().values()
    packed = pack(camera, near, "float32" if gaussians.means.dtype == torch.float32 else "float64")
    means2d, splats, radii, visible, tiles = _Project.apply(*parameters, degree, packed, width, height)
    if means2d.requires_grad:
        means2d.retain_grad()
    rgb, alpha, depth = _Blend.apply(means2d, splats, tiles, background, width, height)
    records = splats.detach().numpy()
    info = {
        "means2d": means2d,
        "radii": radii,
        "visible": visible,
        "conics": torch.from_numpy(records[:, :3]),
        "colours": torch.from_numpy(records[:, 4:7]),
        "depths": torch.from_numpy(records[:, 7]),
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
    one = Gaussians(*(torch.ones(shape) for shape in shapes)).tensors()
    optimiser = GaussianOptimiser(one, dict.fromkeys(one, 0.0))
    render = rasterise_cpu(Gaussians(**optimiser.parameters), camera, torch.ones(3), 3, 0.01)
    (ssim(render.rgb, torch.zeros(16, 16, 3)) + render.depth.sum()).backward()
    optimiser.step()


def pack(camera: Cameras, near: float, dtype: str) -> np.ndarray:
    """(20,), as the projection kernels expect it."""
    matrices = (x.numpy(force=True) for x in (camera.world_from_camera, camera.intrinsics))
    return _pack(*((x.tobytes(), x.dtype) for x in matrices), near, dtype)


Matrix = tuple[bytes, np.dtype]


@lru_cache(maxsize=256)
def _pack(pose: Matrix, intrinsics: Matrix, near: float, dtype: str) -> np.ndarray:
    """Of matrices (4, 4) and (3, 3), by their numbers: those of training views come again and again."""
    motion, k = (np.frombuffer(*x).astype(np.float64) for x in (pose, intrinsics))
    motion, k = motion.reshape(4, 4), k.reshape(3, 3)
    rotation, centre = motion[:3, :3].T, motion[:3, 3]
    lens = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    return np.concatenate([rotation.ravel(), -(rotation @ centre), lens, centre, [near]]).astype(dtype)


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [t.detach().contiguous().numpy() for t in tensors]


def _or_zeros(gradient: Tensor | None, shape: tuple[int, ...], like: np.ndarray) -> np.ndarray:
    """A gradient as an array; torch would fill those that are None with all its threads, which then spin."""
    return np.zeros(shape, like.dtype) if gradient is None else _arrays(gradient)[0]


def _padded(arrays: list[np.ndarray]) -> list[np.ndarray]:
    """Rows of zeros behind arrays that are shorter than a vector: the kernels take no fewer."""
    if len(arrays[0]) >= WIDTH:
        return arrays
    return [np.concatenate([x, np.zeros((WIDTH - len(x), *x.shape[1:]), x.dtype)]) for x in arrays]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, log_scales, quaternions, opacity_logits, sh, degree, camera, width, height):
        ctx.save_for_backward(means, log_scales, quaternions, sh)
        arrays = _padded(_arrays(means, log_scales, quaternions, opacity_logits, sh))
        n, rows, dtype = len(means), len(arrays[0]), arrays[0].dtype
        means2d, splats = np.empty((rows, 2), dtype), np.empty((rows, projection.RECORD), dtype)
        radii, tiles = np.empty((rows, 2), np.int32), np.empty(rows, np.int32)
        visible = np.empty(rows, np.uint8)
        parallel_for(
            projection.project, n, GAUSSIANS_PER_PIECE, *arrays, degree, camera, width, height,
            means2d, splats, radii, visible, tiles,
        )  # fmt: skip
        ctx.rest = (degree, camera, width, height, splats)
        ctx.set_materialize_grads(False)
        out = [torch.from_numpy(x[:n]) for x in (means2d, splats, radii, visible.view(bool), tiles)]
        ctx.mark_non_differentiable(*out[2:])
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means2d, g_splats, *_):
        n, splats = len(ctx.saved_tensors[0]), ctx.rest[-1]
        given = _or_zeros(g_means2d, (n, 2), splats), _or_zeros(g_splats, (n, projection.RECORD), splats)
        arrays = _padded(_arrays(*ctx.saved_tensors))
        # Written whole by the kernel.
        g_means, g_log_scales, g_quaternions, g_sh = (np.empty_like(x) for x in arrays)
        g_opacity_logits = np.empty(len(g_means), g_means.dtype)
        gradients = (g_means, g_log_scales, g_quaternions, g_opacity_logits, g_sh)
        parallel_for(
            projection.project_backward, n, GAUSSIANS_PER_PIECE, *arrays, *ctx.rest, *_padded(list(given)),
            *gradients,
        )  # fmt: skip
        return *(torch.from_numpy(g[:n]) for g in gradients), None, None, None, None


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, splats, counts, background, width, height):
        # The means are an input for their gradient's sake; `splats` holds them, too.
        records, counts, colour = _arrays(splats, counts, background)
        tiles = Tiles(records, counts, width, height)
        dtype, size = colour.dtype, (height, width)
        rgb = np.empty((*size, 3), dtype)
        alpha, depth, transmittance, ends = (np.empty(size, dtype) for _ in range(4))
        reached = np.empty(tiles.count, np.int32)
        parallel_for(
            blending.blend, tiles.count, TILES_PER_PIECE, tiles.starts, tiles.gaussians, tiles.rows, tiles.columns,
            records, colour, rgb, alpha, depth, transmittance, ends, reached,
        )  # fmt: skip
        out = [torch.from_numpy(x) for x in (rgb, alpha, depth)]
        ctx.save_for_backward(splats, background, *out[1:])
        ctx.tiles, ctx.rest = tiles, (transmittance, ends, reached)
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_rgb, g_alpha, g_depth):
        splats, background, alpha, depth = _arrays(*ctx.saved_tensors)
        tiles = ctx.tiles
        outer = [
            _or_zeros(g, shape, alpha)
            for g, shape in ((g_rgb, (*alpha.shape, 3)), (g_alpha, (0, 0)), (g_depth, (0, 0)))
        ]
        sums = np.empty((len(tiles.slots), blending.SUMS), alpha.dtype)
        parallel_for(
            blending.blend_backward, tiles.count, TILES_PER_PIECE, tiles.starts, tiles.gaussians, tiles.rows,
            tiles.slots, tiles.columns, splats, background, alpha, depth, *ctx.rest, *outer, sums,
        )  # fmt: skip
        g_means2d, g_splats = np.empty((len(splats), 2), splats.dtype), np.empty_like(splats)
        parallel_for(
            blending.gather, len(splats), GAUSSIANS_PER_PIECE, tiles.order, tiles.offsets, splats, sums,
            g_means2d, g_splats,
        )  # fmt: skip
        g_background = None
        if ctx.needs_input_grad[3]:
            g_background = torch.from_numpy((outer[0] * ctx.rest[0][..., None]).sum((0, 1)))
        return torch.from_numpy(g_means2d), torch.from_numpy(g_splats), None, g_background, None, None
