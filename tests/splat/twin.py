"""The rasteriser written out plainly: every Gaussian against every pixel, gradients by autograd.

Nothing here is shared with the package: no tiles, no extents, no early exit, its own harmonics.
"""

from __future__ import annotations

import torch

from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion
from visdom_plugin.splat.gaussians import Gaussians


def harmonics(direction, degree):
    """(N, (degree + 1)^2) real harmonics of unit directions (N, 3), constants as in the 3DGS release."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    one = torch.ones_like(x)
    columns = [0.28209479177387814 * one]
    if degree > 0:
        columns += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        columns += [
            1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        ]  # fmt: skip
    if degree > 2:
        columns += [
            -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]  # fmt: skip
    return torch.stack(columns, -1)


def rasterise_twin(g: Gaussians, camera: Cameras, background, *, sh_degree=None, near=0.01):
    """rgb (H, W, 3), alpha (H, W), depth (H, W), and means2d (N, 2) with its gradient retained."""
    degree = g.degree if sh_degree is None else sh_degree
    width, height = int(camera.width), int(camera.height)
    motion, k = camera.camera_from_world.to(g.means), camera.intrinsics.to(g.means)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    local = g.means @ motion[:3, :3].T + motion[:3, 3]
    front = local[:, 2] >= near
    # Behind the camera any harmless number will do: those Gaussians get opacity zero.
    x, y, z = torch.where(front[:, None], local, local.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    if means2d.requires_grad:
        means2d.retain_grad()

    def clamp(ratio, focal, centre, size):
        margin = 0.15 * size / focal
        return ratio.clamp(min=-centre / focal - margin, max=(size - centre) / focal + margin)

    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [fx / z, zero, -fx * clamp(x / z, fx, cx, width) / z,
         zero, fy / z, -fy * clamp(y / z, fy, cy, height) / z], -1,
    ).reshape(-1, 2, 3)  # fmt: skip
    axes = matrix_from_quaternion(g.quaternions) * g.log_scales.exp()[:, None, :]
    covariance = jacobian @ motion[:3, :3] @ axes @ axes.mT @ motion[:3, :3].T @ jacobian.mT
    conic = torch.linalg.inv(covariance + 0.3 * torch.eye(2).to(covariance))
    direction = torch.nn.functional.normalize(g.means - camera.centres.to(g.means), dim=-1)
    basis = harmonics(direction, degree)
    colour = ((basis[..., None] * g.sh[:, : basis.shape[1]]).sum(1) + 0.5).clamp_min(0)
    opacity = torch.where(front, g.opacity_logits.sigmoid(), 0)

    v, u = torch.meshgrid(torch.arange(height).to(x) + 0.5, torch.arange(width).to(x) + 0.5, indexing="ij")
    rgb = x.new_zeros(height, width, 3)
    depth, transmittance = x.new_zeros(height, width), x.new_ones(height, width)
    open_ = torch.ones(height, width, dtype=torch.bool)
    for i in torch.argsort(z, stable=True).tolist():
        dx, dy = means2d[i, 0] - u, means2d[i, 1] - v
        (a, b), (_, c) = conic[i]
        sigma = (a * dx * dx + c * dy * dy) / 2 + b * dx * dy
        alpha = (opacity[i] * torch.exp(-sigma)).clamp_max(0.999)
        hit = open_ & (alpha >= 1 / 255)
        ends = hit & (transmittance * (1 - alpha) <= 1e-4)
        open_ = open_ & ~ends
        alpha = torch.where(hit & ~ends, alpha, 0)
        weight = alpha * transmittance
        rgb = rgb + weight[..., None] * colour[i]
        depth = depth + weight * z[i]
        transmittance = transmittance * (1 - alpha)
    total = 1 - transmittance
    depth = torch.where(total > 0, depth / torch.where(total > 0, total, 1), 0)
    return rgb + transmittance[..., None] * background, total, depth, means2d


def make_camera(width=37, height=29, focal=40.0, centre=(0.5, 0.5), position=(0.3, -0.4, -3.0)) -> Cameras:
    """A camera that looks at the origin; `centre` is the principal point in units of the image size."""
    K = [[focal, 0, centre[0] * width], [0, focal * 1.1, centre[1] * height], [0, 0, 1]]
    position, zero = torch.tensor(position, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    motion = look_at_camera(position, zero, torch.tensor([0.1, -1.0, 0.0], dtype=torch.float64))
    return Cameras.from_matrices(torch.tensor(K, dtype=torch.float64), motion, width=width, height=height)


def make_gaussians(
    n=60, seed=0, dtype=torch.float64, spread=0.8, scale=0.12, opacity=0.0, degree=3
) -> Gaussians:
    """Random Gaussians about the origin, every parameter asking for its gradient."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    values = (
        draw(n, 3) * spread,
        draw(n, 3) * 0.5 + torch.tensor(scale).log(),
        draw(n, 4),
        draw(n) * 1.5 + opacity,
        draw(n, (degree + 1) ** 2, 3) * 0.3,
    )
    return Gaussians(*(v.to(dtype).requires_grad_() for v in values))
