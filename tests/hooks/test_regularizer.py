"""The Gaussian hook: its loss by definition, its views, and a foreign trainer that uses it."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from visdom_plugin import Cameras, Hull, Render, VisDomGaussianRegularizer, VisibleDomain
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import project, rays_of
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hooks.protocols import GaussianHook
from visdom_plugin.hooks.regularizer import outside_loss
from visdom_plugin.hooks.settings import RegularizerSettings
from visdom_plugin.hooks.virtual_views import midpoint_views
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.scene import Views
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
    assert torch.isfinite(alpha.grad).all() and (alpha.grad[1].diff() > 0).all() and (alpha.grad[1] > 0).all()


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
    half = torch.full((SIZE, SIZE), 0.5, requires_grad=True)
    full = Render(torch.ones(SIZE, SIZE, 3), half, torch.ones(SIZE, SIZE))

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


def test_midpoint_views_all_have_their_turn_before_any_has_another(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, views="midpoints", every=2, start=6, weight=1.0)
    views = midpoint_views(cameras)
    seen = []

    def render(camera):
        (number,) = (
            i for i, v in enumerate(views) if torch.equal(v.world_from_camera, camera.world_from_camera)
        )
        seen.append(number)
        return torch.full((SIZE, SIZE), 0.5, requires_grad=True)

    for step in range(6, 6 + 4 * len(views), 2):
        hook.loss(render, step)
    first, second = seen[: len(views)], seen[len(views) :]
    assert sorted(first) == sorted(second) == list(range(len(views))) and first != second
    seen.clear()
    hook = VisDomGaussianRegularizer(hull, cameras, views="midpoints", weight=1.0)
    for _ in range(40):
        hook.loss(render, generator=torch.Generator().manual_seed(len(seen)))
    assert set(seen) == set(range(len(views)))


def test_the_loss_may_go_by_a_hull_of_its_own(ball):
    cameras, hull = ball
    other = VisibleDomain(k=3, resolution=32, dilate_px=5).carve(cameras, capture()[1])
    hook = VisDomGaussianRegularizer(hull, cameras, views="midpoints", weight=1.0, loss_hull=other)
    assert hook.hull is hull

    def render(camera):
        seen.append(camera)
        return torch.full((SIZE, SIZE), 0.5, requires_grad=True)

    seen = []
    loss = hook.loss(render, 0)["visdom_outside"]
    masks = [depth_and_silhouette(h, seen[0])[1] for h in (other, hull)]
    assert masks[0].sum() > masks[1].sum()
    torch.testing.assert_close(loss.detach(), outside_loss(torch.full((SIZE, SIZE), 0.5), masks[0]))
    with pytest.raises(ConfigError, match="no training camera sees"):
        VisDomGaussianRegularizer(hull, cameras, loss_hull=other.relative_to(np.array([0, 0, 500.0])))


def test_settings_carve_the_hull_of_the_loss(ball):
    cameras, hull = ball
    masks = capture()[1]
    views = Views(cameras, [m[..., None].expand(-1, -1, 3).byte() for m in masks], masks, list("abcde"))
    assert RegularizerConfig().build(hull, views).loss_hull is hull
    domain = VisibleDomain(k=4, resolution=40)
    assert RegularizerConfig(loss_hull=domain).build(hull, views).loss_hull == domain.carve(cameras, masks)


def test_points_of_voxels_are_their_middles(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, points="voxels")
    xyz, rgb = hook.initial_points(10 * hull.voxels)
    assert len(xyz) == len(rgb) == hull.voxels
    index = (xyz.numpy() - hull.bounds[0]) / hull.voxel_edges - 0.5
    np.testing.assert_allclose(index, index.round(), atol=1e-3)
    assert hull.occupancy[tuple(index.round().astype(int).T)].all()
    some = hook.initial_points(500, torch.Generator().manual_seed(0))[0]
    assert len(some) == 500 == len(some.unique(dim=0)) and torch.cdist(some, xyz).min(-1).values.max() < 1e-3
    assert some.std(0).min() > 0.8 * xyz.std(0).min()


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


def test_images_of_every_kind_give_the_same_colours(ball):
    cameras, hull = ball
    draw = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (len(cameras), SIZE, SIZE, 3), generator=draw, dtype=torch.uint8)
    flipped = np.ascontiguousarray(images.numpy()[..., ::-1])[
        ..., ::-1
    ]  # BGR turned to RGB: negative strides
    kinds = [list(images), images, images.numpy(), flipped, images.int(), images.numpy().astype(np.uint16)]
    kinds += [images.float() / 255, list(images.numpy().astype(np.float32) / 255)]
    colours = [
        VisDomGaussianRegularizer(hull, cameras, images=kind).initial_points(
            99, torch.Generator().manual_seed(1)
        )[1]
        for kind in kinds
    ]
    assert colours[0].std() > 0.05 and all(torch.equal(colours[0], other) for other in colours[1:])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda image: image.float(), "0 to 1"),
        (lambda image: image.float() / 127.5 - 1, "0 to 1"),
        (lambda image: image.float() * torch.nan, "nan"),
        (lambda image: image.int() * 257, "0 to 255"),
        (lambda image: image[::2, ::2], "shape"),
        (lambda image: image.permute(2, 0, 1), "shape"),
        (lambda image: torch.cat([image, image[..., :1]], -1), "shape"),
        (lambda image: "photograph.png", "str"),
    ],
)
def test_images_of_another_range_or_size_are_refused_by_their_number(ball, change, named):
    cameras, hull = ball
    images = [torch.full((SIZE, SIZE, 3), 9 * i, dtype=torch.uint8) for i in range(1, len(cameras) + 1)]
    images[2] = change(images[2])
    with pytest.raises(ConfigError, match=named) as error:
        VisDomGaussianRegularizer(hull, cameras, images=images)
    assert error.value.where == "images[2]"


def test_there_is_one_image_per_camera(ball):
    cameras, hull = ball
    image = torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8)
    for wrong in ([image], [image] * (len(cameras) + 1), image):
        with pytest.raises(ConfigError, match=f"{len(wrong)} images and {len(cameras)} cameras"):
            VisDomGaussianRegularizer(hull, cameras, images=wrong)


def test_a_hull_that_no_camera_sees_is_refused(ball):
    cameras, hull = ball
    one_sees_it = hull.bounds + 2.0 * cameras[0].forward.numpy()
    VisDomGaussianRegularizer(Hull(hull.occupancy, one_sees_it), cameras)
    for shift in (1000.0, 5.0 * np.eye(3)[2]):
        moved = Hull.from_grid(hull.occupancy, hull.bounds + shift)
        with pytest.raises(ConfigError, match="no training camera sees the hull"):
            VisDomGaussianRegularizer(moved, cameras)


def test_all_gaussians_outside_the_hull_are_told_of_once(ball, caplog):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras, prune_every=1)
    inside = CENTRE[None].float()
    with caplog.at_level(logging.WARNING):
        for means in (torch.zeros(0, 3), torch.cat([inside, inside + 100])):
            hook.after_step(SimpleNamespace(means=means), 0)
        assert not caplog.records
        for step in range(3):
            assert hook.after_step(SimpleNamespace(means=inside + 100), step).all()
    (record,) = caplog.records
    assert "another frame" in record.getMessage()


def test_there_is_one_set_of_defaults(ball):
    cameras, hull = ball
    hook = VisDomGaussianRegularizer(hull, cameras)
    assert hook.config == RegularizerSettings()
    means = CENTRE[None].float() + 100
    marked = [hook.after_step(SimpleNamespace(means=means), step) is not None for step in range(101)]
    assert [step for step, due in enumerate(marked) if due] == [0, 50, 100]
    given = VisDomGaussianRegularizer(hull, cameras, RegularizerConfig(bank=3), weight=0.5)
    assert given.config == RegularizerConfig(bank=3, weight=0.5)


def test_a_schedule_needs_the_step(ball):
    cameras, hull = ball

    def render(camera):
        return torch.full((SIZE, SIZE), 0.5, requires_grad=True)

    assert VisDomGaussianRegularizer(hull, cameras).loss(render)
    for schedule in ({"start": 500}, {"every": 2}):
        hook = VisDomGaussianRegularizer(hull, cameras, **schedule)
        with pytest.raises(ConfigError, match="step"):
            hook.loss(render)
        assert hook.loss(render, 500) and not hook.loss(render, 499)


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        (lambda alpha: (alpha, alpha[None, ..., None], {}), "tuple"),
        (lambda alpha: {"alpha": alpha}, "dict"),
        (lambda alpha: None, "NoneType"),
        (lambda alpha: alpha.detach(), "no gradient"),
    ],
)
def test_what_is_no_opacity_with_a_gradient_is_named(ball, returned, named):
    hook = VisDomGaussianRegularizer(ball[1], ball[0])
    alpha = torch.full((SIZE, SIZE), 0.5, requires_grad=True)
    with pytest.raises(ConfigError, match=named):
        hook.loss(lambda camera: returned(alpha))
    with torch.no_grad():
        assert hook.loss(lambda camera: alpha.detach())["visdom_outside"] > 0
    assert hook.loss(lambda camera: torch.zeros(SIZE, SIZE))["visdom_outside"] == 0


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
    for wrong in (
        {"weight": -1},
        {"weight": float("nan")},
        {"every": 0},
        {"points": "somewhere"},
        {"views": "beside"},
        {"prune_every": -5},
        {"prune_margin_voxels": -1},
        {"prune_margin_voxels": float("nan")},
    ):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
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
            near=0.01,
        )

    for step in range(60):
        adam.zero_grad()
        loss = sum(hook.loss(render, step, g).values())
        loss.backward()
        adam.step()
    assert opacity[60:].sigmoid().max() < 0.2
    assert opacity[:60].sigmoid().median() > 0.45
