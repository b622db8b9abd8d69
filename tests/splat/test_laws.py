"""What must hold of any rasteriser of Gaussians."""

import pytest
import torch

from tests.splat.twin import make_camera, make_gaussians
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from visdom_plugin.splat.cpu import backend, blending, projection, tiles
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise

WHITE = torch.ones(3)


def render_with_gradients(gaussians, camera):
    render = rasterise(gaussians, camera, WHITE, near=0.01)
    (render.rgb.square().sum() + render.depth.sum()).backward()
    gradients = [p.grad for p in gaussians.tensors().values()] + [render.info["means2d"].grad]
    return [render.rgb, render.alpha, render.depth, *gradients]


@pytest.fixture
def thread_count():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_repeats_to_the_bit_with_any_number_of_threads(thread_count):
    results = []
    for threads in (2, 2, 1, 3):
        thread_count(threads)
        gaussians = make_gaussians(n=3000, dtype=torch.float32, scale=0.05)
        results.append(render_with_gradients(gaussians, make_camera(150, 130, focal=160.0)))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_order_of_gaussians_does_not_matter():
    gaussians = make_gaussians(n=500, dtype=torch.float32)
    shuffled = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    other = Gaussians(*(p.detach()[shuffled].requires_grad_() for p in gaussians.tensors().values()))
    first = render_with_gradients(gaussians, make_camera())
    second = render_with_gradients(other, make_camera())
    for i, (a, b) in enumerate(zip(first, second, strict=True)):
        assert torch.equal(a if i < 3 else a[shuffled], b)


def test_a_rigid_motion_of_everything_changes_nothing():
    gaussians, camera = make_gaussians(n=80, degree=0).detach(), make_camera()
    rotation = matrix_from_quaternion(torch.tensor([0.4, -0.7, 0.2, 0.5], dtype=torch.float64))
    shift = torch.tensor([3.0, -20.0, 1.0], dtype=torch.float64)
    axes = rotation @ matrix_from_quaternion(gaussians.quaternions)
    moved = Gaussians(
        gaussians.means @ rotation.T + shift, gaussians.log_scales, quaternion_from_matrix(axes),
        gaussians.opacity_logits, gaussians.sh,
    )  # fmt: skip
    motion = camera.world_from_camera.clone()
    motion[:3, :3] = rotation @ motion[:3, :3]
    motion[:3, 3] = rotation @ motion[:3, 3] + shift
    a = rasterise(gaussians, camera, WHITE, near=0.01)
    b = rasterise(moved, Cameras(camera.intrinsics, motion, camera.width, camera.height), WHITE, near=0.01)
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-9)


def test_a_camera_whose_pose_is_changed_in_place_is_drawn_where_it_now_is():
    gaussians, camera = make_gaussians(n=300).detach(), make_camera()
    before = rasterise(gaussians, camera, WHITE, near=0.01)
    camera.world_from_camera[:3, 3] *= 1.1
    after = rasterise(gaussians, camera, WHITE, near=0.01)
    fresh = make_camera()
    fresh.world_from_camera[:3, 3] *= 1.1
    assert torch.equal(after.rgb, rasterise(gaussians, fresh, WHITE, near=0.01).rgb)
    assert not torch.equal(after.rgb, before.rgb)


def test_alpha_is_bounded_and_the_background_enters_linearly():
    gaussians = make_gaussians(n=400, dtype=torch.float32, scale=0.3, opacity=4.0).detach()
    backgrounds = torch.tensor([[0.0, 0.0, 0.0], [0.3, 1.0, 0.6]])
    black, coloured = (rasterise(gaussians, make_camera(), b, near=0.01) for b in backgrounds)
    assert (black.alpha >= 0).all() and (black.alpha <= 1).all() and black.alpha.max() > 0.99
    expected = black.rgb + (1 - black.alpha)[..., None] * backgrounds[1]
    torch.testing.assert_close(coloured.rgb, expected, rtol=0, atol=1e-6)


def test_depth_lies_between_the_nearest_and_the_farthest():
    gaussians = make_gaussians(n=50).detach()
    render = rasterise(gaussians, make_camera(), WHITE, near=0.01)
    z = render.info["depths"][render.info["visible"]]
    hit = render.alpha > 0
    assert (render.depth[hit] >= z.min() - 1e-9).all() and (render.depth[hit] <= z.max() + 1e-9).all()
    assert not render.depth[~hit].any()


def test_no_gaussians_show_the_background():
    gaussians = make_gaussians(n=0, dtype=torch.float32)
    render = rasterise(gaussians, make_camera(), torch.tensor([0.1, 0.2, 0.3]), near=0.01)
    render.rgb.sum().backward()
    assert torch.equal(render.rgb, torch.tensor([0.1, 0.2, 0.3]).expand_as(render.rgb))
    assert not render.alpha.any() and not render.depth.any()
    assert gaussians.means.grad.shape == (0, 3)


def test_one_gaussian_on_the_axis_peaks_at_the_principal_point_with_its_depth():
    camera = make_camera(width=21, height=21, centre=(10.5 / 21, 10.5 / 21))
    one = Gaussians(
        torch.zeros(1, 3), torch.full((1, 3), -2.0), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    render = rasterise(one, camera, torch.zeros(3), near=0.01)
    assert render.alpha.argmax() == 10 * 21 + 10
    assert render.alpha[10, 10].item() == pytest.approx(0.5, abs=1e-4)
    assert render.rgb[10, 10, 0].item() == pytest.approx(0.25, abs=1e-4)
    assert render.depth[10, 10].item() == pytest.approx(camera.centres.norm().item(), rel=1e-5)


def test_what_is_not_drawn_gets_no_gradient_and_no_radius():
    gaussians, camera = make_gaussians(n=6, dtype=torch.float32, spread=0.1), make_camera()
    with torch.no_grad():
        gaussians.means[0] = camera.centres.float() - 2 * camera.forward.float()  # behind
        gaussians.means[1, 0] = 1e4  # far beside
        gaussians.opacity_logits[2] = -9.0  # below 1/255
        gaussians.means[3, 1] = float("nan")
        gaussians.log_scales[4, 2] = float("nan")
    render = rasterise(gaussians, camera, WHITE, near=0.01)
    (render.rgb.sum() + render.depth.sum()).backward()
    assert render.info["visible"].tolist() == [False] * 5 + [True]
    assert torch.equal(render.info["visible"], (render.info["radii"] > 0).all(-1))
    assert torch.isfinite(render.rgb).all() and render.alpha.any()
    for name, parameter in gaussians.tensors().items():
        assert not parameter.grad[:5].any() and parameter.grad[5].any(), name


def test_gradients_of_several_renders_add_up():
    """Hooks draw more views of the same Gaussians before one backward pass."""
    cameras = [make_camera(), make_camera(position=(2.0, 0.5, -2.0))]
    apart = []
    for camera in cameras:
        gaussians = make_gaussians(n=40)
        rasterise(gaussians, camera, WHITE, near=0.01).rgb.square().sum().backward()
        apart.append(gaussians.means.grad)
    gaussians = make_gaussians(n=40)
    renders = [rasterise(gaussians, camera, WHITE, near=0.01) for camera in cameras]
    sum(r.rgb.square().sum() for r in renders).backward()
    torch.testing.assert_close(gaussians.means.grad, apart[0] + apart[1])


def test_warm_up_leaves_nothing_to_compile():
    kernels = [
        projection.project, projection.project_backward, tiles._sort_chunks, tiles._list,
        tiles._start, tiles._fill, blending.blend, blending.blend_backward, blending.gather,
    ]  # fmt: skip
    backend.warm_up()
    before = [len(kernel.signatures) for kernel in kernels]
    for n, camera in ((50, make_camera()), (0, make_camera(5, 3)), (7, make_camera(100, 20))):
        render_with_gradients(make_gaussians(n=n, dtype=torch.float32, degree=min(n, 3)), camera)
    assert [len(kernel.signatures) for kernel in kernels] == before


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"backend": "cuda"}, "unknown backend"),
        ({"backend": "gsplat"}, "device cpu"),
        ({"sh_degree": 3}, "sh_degree is 3"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        rasterise(make_gaussians(n=2, degree=1), make_camera(), WHITE, **arguments, near=0.01)


def test_a_batch_of_cameras_is_refused():
    with pytest.raises(ConfigError, match="one camera"):
        rasterise(make_gaussians(n=2), Cameras.stack([make_camera()] * 2), WHITE, near=0.01)
