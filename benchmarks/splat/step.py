# ruff: noqa: E402
"""Time of one training step of Gaussian splatting on the CPU, against a dense torch rasteriser in the same run.

    python benchmarks/splat/step.py [--repeats 15] [--sizes 200000x800]

A step is forward, 0.8 L1 + 0.2 (1 - SSIM), backward, and Adam over all parameters, harmonics of degree 3. The
Gaussians cover a sphere that fills most of the image. Times are the least of the repeats.

The dense reference holds every (Gaussian, pixel) pair in memory, so it is measured at a small size; its time
grows with the number of pairs, and the last column states what that makes of it at the row's size.
"""

from __future__ import annotations

import argparse
import itertools
import math
import resource
import time

from visdom_plugin.compute.process import keep_freed_memory, wait_briefly

wait_briefly()  # before torch is imported, as the commands do
keep_freed_memory()

import torch

from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.losses import photometric_loss
from visdom_plugin.splat.cpu.backend import warm_up
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.optimiser import GaussianOptimiser
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.ssim import _ssim_by_convolution

SIZES = ((2_000, 100), (5_000, 100), (20_000, 200), (50_000, 400))
DENSE_SIZE = SIZES[0]
PARTS = ("forward", "loss", "backward", "adam")


def sphere(n: int, seed: int) -> Gaussians:
    """n Gaussians about the unit sphere, as wide as their distance from each other, opacities about one half."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    means = torch.nn.functional.normalize(draw(n, 3), dim=-1) * (1 + 0.02 * draw(n, 1))
    log_scales = 0.5 * math.log(4 * math.pi / n) + 0.3 * draw(n, 3)
    return Gaussians(means, log_scales, draw(n, 4), 1.5 * draw(n), 0.2 * draw(n, 16, 3))


def camera_of(size: int) -> Cameras:
    motion = look_at_camera(torch.tensor([0.3, -0.4, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    K = torch.tensor([[1.1 * size, 0, size / 2], [0, 1.1 * size, size / 2], [0, 0, 1]])
    return Cameras.from_matrices(K, motion, width=size, height=size)


def dense(gaussians: Gaussians, camera: Cameras, background: torch.Tensor) -> torch.Tensor:
    """rgb (H, W, 3) from all pairs at once; colours of degree 0, no early exit: less work than the real step."""
    motion, k, size = camera.camera_from_world, camera.intrinsics, int(camera.width)
    local = gaussians.means @ motion[:3, :3].T + motion[:3, 3]
    x, y, z = local.unbind(-1)
    zero = torch.zeros_like(z)
    rows = [k[0, 0] / z, zero, -k[0, 0] * x / z**2, zero, k[1, 1] / z, -k[1, 1] * y / z**2]
    jacobian = torch.stack(rows, -1).reshape(-1, 2, 3)
    axes = matrix_from_quaternion(gaussians.quaternions) * gaussians.log_scales.exp()[:, None]
    half = jacobian @ motion[:3, :3] @ axes
    conic = torch.linalg.inv(half @ half.mT + 0.3 * torch.eye(2))
    order = z.argsort()
    u, v = k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]
    pixels = torch.arange(size) + 0.5
    dx = (u[order, None] - pixels)[:, None, :]
    dy = (v[order, None] - pixels)[:, :, None]
    a, b, c = (conic[order, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    alpha = gaussians.opacity_logits[order].sigmoid()[:, None, None]
    alpha = alpha * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.999), 0)
    left = torch.cumprod(1 - alpha, 0)
    weight = alpha * torch.cat([torch.ones_like(left[:1]), left[:-1]])
    colour = (0.28209479177387814 * gaussians.sh[order, 0] + 0.5).clamp_min(0)
    return torch.einsum("nhw,nc->hwc", weight, colour) + left[-1][..., None] * background


def time_step(n: int, size: int, repeats: int, reference: bool) -> list[float]:
    """Least milliseconds of each of PARTS, and of the whole step."""
    camera, background = camera_of(size), torch.ones(3)

    def compare(rgb: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        if reference:
            return 0.8 * (rgb - target).abs().mean() + 0.2 * (1 - _ssim_by_convolution(rgb, target))
        return photometric_loss(rgb, target, 0.2)

    def draw(gaussians: Gaussians) -> torch.Tensor:
        if reference:
            return dense(gaussians, camera, background)
        return rasterise(gaussians, camera, background, near=0.01).rgb

    start = sphere(n, 0).tensors()
    optimiser = GaussianOptimiser(start, dict.fromkeys(start, 1e-4))
    with torch.no_grad():
        target = draw(sphere(n, 1))
    best = [math.inf] * (len(PARTS) + 1)
    for _ in range(repeats):
        at = [time.perf_counter()]
        rgb = draw(Gaussians(**optimiser.parameters))
        at.append(time.perf_counter())
        loss = compare(rgb, target)
        at.append(time.perf_counter())
        loss.backward()
        at.append(time.perf_counter())
        optimiser.step()
        at.append(time.perf_counter())
        spans = [1e3 * (b - a) for a, b in itertools.pairwise(at)] + [1e3 * (at[-1] - at[0])]
        best = [min(b, s) for b, s in zip(best, spans, strict=True)]
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--sizes", nargs="+", metavar="NxP", help="N Gaussians on P x P pixels")
    arguments = parser.parse_args()
    repeats = arguments.repeats
    sizes = [tuple(map(int, size.split("x"))) for size in arguments.sizes or ()] or SIZES
    start = time.perf_counter()
    warm_up()
    print(f"kernels ready after {time.perf_counter() - start:.1f} s; {torch.get_num_threads()} threads")
    rows = []
    for n, size in sizes:
        times = time_step(n, size, repeats, reference=False)
        # The most the process held so far, in MB where ru_maxrss counts kilobytes (Linux).
        rows.append((n, size, times, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024))
    n, size = DENSE_SIZE
    reference = time_step(n, size, max(2, repeats // 5), reference=True)[-1]
    pairs = n * size * size
    print(f"dense torch, {n} Gaussians, {size} x {size}: {reference:.0f} ms per step")
    columns = "".join(f"{part:>10}" for part in (*PARTS, "step", "most"))
    print(f"{'Gaussians':>9} {'image':>9} {columns}   dense / step")
    for n, size, times, memory in rows:
        scaled = reference * n * size * size / pairs
        note = "measured" if (n, size) == DENSE_SIZE else "scaled by pairs"
        cells = "".join(f"{t:7.1f} ms" for t in times)
        print(f"{n:9d} {size:4d}x{size:<4d} {cells} {memory:6d} MB   {scaled / times[-1]:.0f} x ({note})")


if __name__ == "__main__":
    main()
