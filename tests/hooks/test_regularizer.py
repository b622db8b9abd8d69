"""The Gaussian hook: its loss by definition, its views, and a foreign trainer that uses it."""

import pytest
import torch

from visdom_plugin import Cameras, Render, VisDomGaussianRegularizer, VisibleDomain
from visdom_plugin.cameras import look_at_camera, project, rays_of
from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hooks.regularizer import outside_loss
from visdom_plugin.hull.raycast import depth_and_silhouette
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise

CENTRE, RADIUS, SIZE = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64), 0.6, 48


def capture(n: int = 5) -> tuple[Cameras, list[torch.Tensor]]:
    """Cameras around a ball and its exact masks."""
    angle = torch.arange(n, dtype=torch.float64) * (2 * torch.pi / n)
    offset = torch.stack([angle.cos(), angle.sin(), 0.3 + 0.2 * (3 * angle).sin()], -1)
    motion = look_at_camera(CENTRE + 3 * offset, CENTRE, CENTRE.new_tensor([0, 0, 1]))
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras.from_matrices(K, motion, width=SIZE, height=SIZE)
    masks = []
    for camera in (cameras[i] for i in range(n)):
        rays = rays_of(camera)
        to_centre = CENTRE - rays.origins
        along = (to_centre * rays.directions).sum(-1)
        masks.append((to_centre.square().sum(-1) - along**2) < RADIUS**2)
    return cameras, masks


@pytest.fixture(scope="module")
def ball():
    cameras, masks = capture()
    return cameras, VisibleDomain(k=3, resolution=64).carve(cameras, masks)


def test_outside_loss_is_the_equation():
    g = torch.Generator().manual_seed(0)
    alpha, mask = torch.rand(5, 7, generator=g), torch.rand(5, 7, generator=g) > 0.5
    total = 0.0
    for row in range(5):
        for column in range(7):
            M = float(mask[row, column])
            total += -(1 - M) * torch.log(1 - alpha[row, column])
    torch.testing.assert_close(outside_loss(alpha, mask), total / 35)


def test_outside_loss_pulls_beside_the_hull_only_and_stays_finite():
    alpha = torch.tensor([[0.0, 0.5, 1.0], [0.0, 0.5, 1.0]], requires_grad=True)
    mask = torch.tensor([[True] * 3, [False] * 3])
    outside_loss(alpha, mask).backward()
    assert (alpha.grad[0] == 0).all()
    assert torch.isfinite(alpha.grad).all() and (alpha.grad[1, :2] > 0).all()


def test_views_of_the_loss_lie_between_training_cameras_and_see_the_hull(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras)
    g = torch.Generator().manual_seed(0)
    for _ in range(20):
        camera = hook.sample_camera(g)
        distance = (camera.centres - CENTRE).norm()
        assert 2.0 < distance < 4.0
        uv, depth = project(camera, CENTRE[None])
        assert depth > 0 and (uv - SIZE / 2).abs().max() < 2


def test_loss_is_a_pure_function_of_the_generator_and_follows_its_schedule(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, every=3, start=4, weight=0.5)
    full = Render(torch.ones(SIZE, SIZE, 3), torch.full((SIZE, SIZE), 0.5), torch.ones(SIZE, SIZE))

    def value(step, seed):
        return hook.loss(lambda camera: full, step, torch.Generator().manual_seed(seed))

    assert [step for step in range(12) if value(step, 0)] == [4, 7, 10]
    assert torch.equal(value(4, 1)["visdom_outside"], value(7, 1)["visdom_outside"])
    # alpha = 0.5 everywhere: the loss is weight * log 2 * (share of pixels beside the hull).
    share = value(4, 1)["visdom_outside"] / (0.5 * torch.log(torch.tensor(2.0)))
    assert 0.5 < share < 0.95


def test_views_of_the_bank_are_the_same_in_every_process(ball):
    cameras, hull = ball
    first, second = (VisDomGaussianRegularizer(hull, cameras, bank=5) for _ in range(2))
    seen = set()
    for seed in range(40):
        views = [hook._draw(torch.Generator().manual_seed(seed)) for hook in (first, second)]
        assert torch.equal(views[0][0].world_from_camera, views[1][0].world_from_camera)
        assert torch.equal(views[0][1], depth_and_silhouette(hull, views[1][0])[1])
        seen.add(tuple(views[0][0].centres.tolist()))
    assert len(seen) == 5
    fresh = VisDomGaussianRegularizer(hull, cameras, bank=0)
    assert len({tuple(fresh._draw(None)[0].centres.tolist()) for _ in range(8)}) == 8


def test_initial_points_lie_in_the_hull_and_take_the_photographs_colour(ball):
    cameras, hull = ball
    red = torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8)
    red[..., 0] = 255
    for where in ("surface", "volume"):
        hook = VisDomGaussianRegularizer(hull, cameras, images=[red] * len(cameras), points=where)
        xyz, rgb = hook.initial_points(500, torch.Generator().manual_seed(0))
        assert xyz.shape == rgb.shape == (500, 3)
        assert bool(hull.contains(xyz, margin_voxels=1.0).all())
        assert torch.allclose(rgb, torch.tensor([1.0, 0, 0]).expand_as(rgb), atol=0.02)
    assert isinstance(hook, GaussianHook)


def test_removal_is_asked_for_outside_the_margin_only(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, prune_every=10, prune_margin_voxels=3)
    step = hull.voxel_size

    class Cloud:
        means = (CENTRE + torch.tensor([[0.0, 0, 0], [0, 0, 3.0], [RADIUS + 1.0 * step, 0, 0]])).float()

    assert hook.after_step(Cloud, 9) is None
    assert hook.after_step(Cloud, 10).tolist() == [False, True, False]


def test_bad_settings_are_refused(ball):
    cameras, hull = ball
    for wrong in ({"weight": -1}, {"every": 0}, {"points": "somewhere"}):
        with pytest.raises(ConfigError):
            VisDomGaussianRegularizer(hull, cameras, **wrong)
    with pytest.raises(ConfigError, match="two training cameras"):
        VisDomGaussianRegularizer(hull, cameras[:1])


def test_a_foreign_training_loop_fades_what_floats_outside(ball):
    """A trainer that knows nothing of this package but a hook and somebody's rasteriser."""
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, weight=1.0)
    g = torch.Generator().manual_seed(0)
    sphere = torch.nn.functional.normalize(torch.randn(80, 3, generator=g), dim=-1)
    distance = torch.cat([torch.full((60,), 0.5 * RADIUS), torch.full((20,), 2 * RADIUS)])
    means = CENTRE.float() + distance[:, None] * sphere
    opacity = torch.zeros(80, requires_grad=True)
    adam = torch.optim.Adam([opacity], lr=0.1)

    def render(camera):
        return rasterise(
            Gaussians(
                means=means,
                log_scales=torch.full((80, 3), -3.0),
                quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(80, 1),
                opacity_logits=opacity,
                sh=torch.zeros(80, 1, 3),
            ),
            camera,
            torch.ones(3),
        )

    for step in range(60):
        adam.zero_grad()
        loss = sum(hook.loss(render, step, g).values())
        loss.backward()
        adam.step()
    assert opacity[60:].sigmoid().max() < 0.2
    assert opacity[:60].sigmoid().median() > 0.45
