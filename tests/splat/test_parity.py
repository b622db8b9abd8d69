"""The fast rasteriser against the dense twin, in value and gradient, and against finite differences."""

import pytest
import torch

from tests.splat.twin import make_camera, make_gaussians, rasterise_twin
from visdom_plugin.splat.rasterise import rasterise

SCENES = {
    "plain": {"n": 60},
    "opaque": {"n": 150, "scale": 0.08, "opacity": 3.0},
    "larger than the image": {"n": 12, "scale": 2.0, "opacity": 1.0},
    "behind and beside the camera": {"n": 120, "spread": 3.0},
    "constant colours": {"n": 30, "degree": 0},
}
CAMERAS = {
    "centred": {},
    "off centre, odd size": {"width": 41, "height": 19, "centre": (0.1, 0.8)},
    "principal point outside": {"width": 16, "height": 33, "centre": (1.3, -0.2), "focal": 25.0},
}
PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def weigh(rgb, alpha, depth):
    """A scalar that depends on every output in its own way."""
    generator = torch.Generator().manual_seed(7)
    weights = [
        torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in (rgb, alpha, depth)
    ]
    return sum((w * x).sum() for w, x in zip(weights, (rgb, alpha, depth), strict=True))


def both(scene, camera, dtype, sh_degree=None):
    camera = make_camera(**CAMERAS[camera])
    fast, slow = make_gaussians(**SCENES[scene], dtype=dtype), make_gaussians(**SCENES[scene])
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    backgrounds = [background.to(d, copy=True).requires_grad_() for d in (dtype, torch.float64)]
    render = rasterise(fast, camera, backgrounds[0], sh_degree=sh_degree, near=0.01)
    rgb, alpha, depth, means2d = rasterise_twin(slow, camera, backgrounds[1], sh_degree=sh_degree)
    weigh(render.rgb, render.alpha, render.depth).backward()
    weigh(rgb, alpha, depth).backward()
    values = {"rgb": (render.rgb, rgb), "alpha": (render.alpha, alpha), "depth": (render.depth, depth)}
    gradients = {k: (getattr(fast, k).grad, getattr(slow, k).grad) for k in PARAMETERS}
    gradients["background"] = tuple(b.grad for b in backgrounds)
    gradients["means2d"] = (render.info["means2d"].grad, means2d.grad)
    return values, gradients


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("scene", SCENES)
def test_equals_twin_in_float64(scene, camera):
    values, gradients = both(scene, camera, torch.float64)
    assert values["alpha"][1].detach().max() > 0.05
    for name, (ours, theirs) in (values | gradients).items():
        torch.testing.assert_close(
            ours, theirs, rtol=1e-10, atol=1e-11 * max(1, theirs.abs().max().item()), msg=name
        )


@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_the_gradient_of_one_output_equals_the_twins(output):
    camera, background = (
        make_camera(**CAMERAS["off centre, odd size"]),
        torch.tensor([0.2, 0.5, 0.9]).double(),
    )
    fast, slow = make_gaussians(n=60), make_gaussians(n=60)
    ours = getattr(rasterise(fast, camera, background, near=0.01), output)
    theirs = dict(zip(("rgb", "alpha", "depth"), rasterise_twin(slow, camera, background), strict=False))[
        output
    ]
    for value in (ours, theirs):
        value.square().sum().backward()
    for name in PARAMETERS:
        expected = getattr(slow, name).grad
        expected = torch.zeros_like(getattr(slow, name)) if expected is None else expected
        scale = max(1, expected.abs().max().item())
        torch.testing.assert_close(
            getattr(fast, name).grad, expected, rtol=1e-10, atol=1e-11 * scale, msg=name
        )


@pytest.mark.parametrize("scene", SCENES)
def test_equals_twin_in_float32(scene):
    """A pixel whose alpha rounds to the other side of 1/255 may differ by that much; all others are tight."""
    values, gradients = both(scene, "off centre, odd size", torch.float32)
    for name, (ours, theirs) in values.items():
        error = (ours - theirs).detach().abs()
        assert error.median() < 1e-6, name
        assert (error > 1e-4).double().mean() < 0.01, name
    for name, (ours, theirs) in gradients.items():
        assert (ours - theirs).norm() < 1e-3 * theirs.norm(), name


@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_lower_degree_equals_twin(sh_degree):
    values, gradients = both("plain", "centred", torch.float64, sh_degree)
    for name, (ours, theirs) in (values | gradients).items():
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-10, msg=name)
    assert not gradients["sh"][0][:, (sh_degree + 1) ** 2 :].any()


@pytest.mark.parametrize("name", PARAMETERS)
def test_gradients_equal_finite_differences(name):
    camera, background = make_camera(centre=(0.3, 0.6)), torch.tensor([0.1, 0.8, 0.4])
    gaussians = make_gaussians(n=25)

    def loss():
        render = rasterise(gaussians, camera, background, near=0.01)
        return weigh(render.rgb, render.alpha, render.depth)

    loss().backward()
    parameter = getattr(gaussians, name)
    direction = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    slope = (parameter.grad * direction).sum()
    with torch.no_grad():
        step = 1e-7 * direction
        parameter += step
        high = loss()
        parameter -= 2 * step
        low = loss()
    torch.testing.assert_close((high - low) / 2e-7, slope, rtol=1e-5, atol=1e-6)


def test_projection_and_harmonics_equal_gsplat():
    torch_impl = pytest.importorskip(
        "gsplat.cuda._torch_impl", reason="gsplat (extra [cuda]) is not installed", exc_type=ImportError
    )
    camera = make_camera(width=41, height=19, centre=(0.2, 0.7))
    gaussians = make_gaussians(n=200, spread=1.5, opacity=2.0).detach()
    covariances, _ = torch_impl._quat_scale_to_covar_preci(
        gaussians.quaternions, gaussians.log_scales.exp(), compute_preci=False
    )
    matrices = (camera.camera_from_world[None], camera.intrinsics[None])
    radii, means2d, depths, conics, _ = torch_impl._fully_fused_projection(
        gaussians.means, covariances, *matrices, 41, 19
    )
    for degree in range(4):
        info = rasterise(gaussians, camera, torch.zeros(3), sh_degree=degree, near=0.01).info
        seen = info["visible"]
        assert 20 < seen.sum() < 200
        direction = gaussians.means - camera.centres
        colours = (torch_impl._spherical_harmonics(degree, direction, gaussians.sh) + 0.5).clamp_min(0)
        torch.testing.assert_close(info["colours"][seen], colours[seen], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(info["means2d"][seen], means2d[0, seen])
    torch.testing.assert_close(info["conics"][seen], conics[0, seen])
    torch.testing.assert_close(info["depths"][seen], depths[0, seen])
    # gsplat's CUDA radii shrink with the opacity, its torch radii do not.
    assert (info["radii"][seen] <= radii[0, seen]).all()
