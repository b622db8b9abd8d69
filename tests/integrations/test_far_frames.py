"""Other people's trainers far from the origin: the same bounds and points, or a refusal."""

import numpy as np
import pytest
import torch

from visdom_plugin import Hull, VisDomGaussianRegularizer, VisDomSampler
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.geometry.local_frame import local_origin
from visdom_plugin.integrations.gsplat import VisDomStrategy
from visdom_plugin.integrations.nerfacc import confine, ray_limits
from visdom_plugin.integrations.nerfstudio.frame import similarity_of
from visdom_plugin.integrations.nerfstudio.rays import bound_model_rays

from ..hull.balls import ring
from .test_nerfacc_adapter import estimator_like

FAR = pytest.mark.parametrize("far", [1e5, 5e6])


def place(far: float) -> tuple[Cameras, Hull]:
    """Cameras round a ball of radius 0.5, whose frame has its origin `far` away."""
    axis = (np.arange(32) + 0.5) / 16 - 1
    grid = np.square(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"))).sum(0) < 0.25
    shift = far * np.array([1.0, -0.7, 0.3])
    hull = Hull.from_grid(grid, [[-1.0] * 3, [1.0] * 3]).relative_to(-shift)
    return ring(5, distance=4.0).relative_to(-torch.from_numpy(shift)), hull


def pixels() -> torch.Tensor:
    return 64 * torch.rand(5, 300, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@FAR
def test_nerfstudios_rays_are_bounded_alike(far):
    found = []
    for cameras, hull in (place(0), place(far)):
        frame, hook = similarity_of(cameras), VisDomSampler(hull, cameras=cameras)
        poses = frame.poses_to_model(cameras)
        rays = rays_of(cameras, pixels())
        directions = (rays.directions @ frame.transform[:, :3].mT).float()
        origins = poses[:, None, :, 3].expand_as(directions).float()
        near = torch.full(directions.shape[:-1], 0.05)
        seeds = frame.points_to_model(
            VisDomGaussianRegularizer(hull, cameras).initial_points(200, torch.Generator().manual_seed(0))[0]
        )
        bounds = bound_model_rays(hook, frame, origins, directions, near, 1000 * near)
        found.append((poses, seeds.float(), *bounds))
    (poses, seeds, near, end, hit), (far_poses, far_seeds, far_near, far_end, far_hit) = found
    assert torch.allclose(poses, far_poses, atol=1e-7) and torch.allclose(seeds, far_seeds, atol=1e-6)
    same = hit == far_hit
    assert (~same).sum() <= 2 and 0.05 < hit.float().mean() < 0.9
    assert torch.allclose(near[same], far_near[same], atol=1e-5)
    assert ((end - far_end).abs() < 1e-5)[same].float().mean() > 0.995


@FAR
def test_gsplat_takes_a_frame_near_the_scene_alone(far):
    cameras, hull = place(far)
    with pytest.raises(ConfigError, match="relative_to"):
        VisDomStrategy(VisDomGaussianRegularizer(hull, cameras))
    origin = local_origin(cameras)
    hook = VisDomGaussianRegularizer(hull.relative_to(origin), cameras.relative_to(origin))
    there, rgb = VisDomStrategy(hook).initial_points(100)
    here, _ = VisDomStrategy(VisDomGaussianRegularizer(*reversed(place(0)))).initial_points(100)
    assert there.dtype == rgb.dtype == torch.float32
    back = there + (origin - far * torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64))
    assert (back - here).abs().max() < 1e-5


@FAR
def test_nerfacc_takes_a_frame_near_the_scene_alone(far):
    cameras, hull = place(far)
    estimator = estimator_like()
    estimator.aabbs = estimator.aabbs + (far * torch.tensor([1.0, -0.7, 0.3])).repeat(2)
    with pytest.raises(ConfigError, match="relative_to"):
        confine(estimator, hull)
    origin = far * torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64)
    near, there = estimator_like(), estimator_like()
    assert confine(near, place(0)[1]) == confine(there, hull.relative_to(origin))
    assert torch.equal(near.occs, there.occs)
    rays = [rays_of(c, pixels()) for c in (place(0)[0], cameras.relative_to(origin))]
    hulls = place(0)[1], hull.relative_to(origin)
    limits = [
        ray_limits(VisDomSampler(h), r.origins.float(), r.directions.float(), 0.1, 9.0)
        for h, r in zip(hulls, rays, strict=True)
    ]
    close = [(limits[0][k] - limits[1][k]).abs() < 1e-4 for k in ("t_min", "t_max")]
    assert all(x.float().mean() > 0.995 for x in close)


@FAR
def test_the_regularizer_is_the_same_in_float64(far):
    """Points to start from, silhouettes of L_i and what leaves the hull, in the capture's own frame."""
    found = []
    for cameras, hull in (place(0), place(far)):
        hook = VisDomGaussianRegularizer(hull, cameras, prune_every=1, bank=4)
        xyz, _ = hook.initial_points(300, torch.Generator().manual_seed(0))
        assert hull.contains(xyz, margin_voxels=1).all()
        opacity = torch.full((int(cameras.height[0]), int(cameras.width[0])), 0.5, requires_grad=True)
        loss = hook.loss(lambda camera, drawn=opacity: drawn, 0, torch.Generator().manual_seed(1))
        step = torch.randn(300, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        gone = hook.after_step(type("Cloud", (), {"means": torch.from_numpy(hull.centre) + 0.4 * step}), 0)
        found.append((xyz.double() - torch.from_numpy(hull.centre), loss["visdom_outside"], gone))
    (xyz, loss, gone), (far_xyz, far_loss, far_gone) = found
    assert (xyz - far_xyz).abs().max() < 1e-6 and torch.allclose(loss, far_loss, rtol=1e-3)
    assert torch.equal(gone, far_gone) and 0.1 < gone.float().mean() < 0.9
