"""What is handed to gsplat and what comes back, with a stand-in for gsplat that keeps its signature."""

import inspect
import sys
import types

import pytest
import torch

from tests.splat.twin import make_camera, make_gaussians
from visdom_plugin.errors import PluginError
from visdom_plugin.splat.backend_gsplat import rasterise_gsplat
from visdom_plugin.splat.rasterise import rasterise


def fake_rasterization(seen):
    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, sh_degree=None,
        packed=True, backgrounds=None, render_mode="RGB",
    ):  # fmt: skip
        seen.update(locals())
        n = len(means)
        means2d = means[None, :, :2] * 2
        image = means2d.sum() * torch.ones(1, height, width, 4)
        radii = torch.arange(2 * n, dtype=torch.int32).reshape(1, n, 2)
        meta = {"means2d": means2d, "radii": radii, "depths": torch.ones(1, n), "conics": torch.ones(1, n, 3)}
        return image, torch.ones(1, height, width, 1), meta

    return rasterization


@pytest.fixture
def seen(monkeypatch):
    seen = {}
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=fake_rasterization(seen)))
    return seen


def test_arguments_and_results_have_the_right_shapes_and_meaning(seen):
    gaussians, camera = make_gaussians(n=5, dtype=torch.float32), make_camera(20, 10)
    render = rasterise_gsplat(gaussians, camera, torch.ones(3), 2, 0.05)
    assert seen["viewmats"].shape == (1, 4, 4) and seen["Ks"].shape == (1, 3, 3)
    assert seen["colors"].shape == (5, 16, 3) and seen["backgrounds"].shape == (1, 3)
    assert (seen["width"], seen["height"], seen["sh_degree"], seen["near_plane"]) == (20, 10, 2, 0.05)
    assert seen["packed"] is False and seen["render_mode"] == "RGB+ED"
    torch.testing.assert_close(seen["viewmats"][0] @ camera.world_from_camera.float(), torch.eye(4))
    assert torch.equal(seen["scales"], gaussians.log_scales.exp())
    assert torch.equal(seen["opacities"], gaussians.opacity_logits.sigmoid())
    assert render.rgb.shape == (10, 20, 3) and render.alpha.shape == render.depth.shape == (10, 20)
    assert render.info["visible"].tolist() == [False, True, True, True, True]
    render.rgb.sum().backward()
    assert torch.equal(render.info["means2d"].grad, torch.full((5, 2), 600.0))


def test_the_real_signature_takes_these_arguments():
    rendering = pytest.importorskip("gsplat.rendering", reason="gsplat (extra [cuda]) is not installed")
    wanted = inspect.signature(fake_rasterization({})).parameters
    assert set(wanted) <= set(inspect.signature(rendering.rasterization).parameters)


def test_a_missing_gsplat_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(PluginError, match=r"visdom-plugin\[cuda\]"):
        rasterise_gsplat(make_gaussians(n=1), make_camera(), torch.ones(3), 0, 0.01)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_both_backends_draw_the_same():
    pytest.importorskip("gsplat", reason="gsplat (extra [cuda]) is not installed")
    camera, background = make_camera(61, 45, centre=(0.3, 0.6)), torch.tensor([0.2, 0.5, 0.9])
    results = []
    for device in ("cpu", "cuda"):
        gaussians = make_gaussians(n=300, dtype=torch.float32).detach().to(device)
        for parameter in gaussians.tensors().values():
            parameter.requires_grad_()
        render = rasterise(gaussians, camera.to(device), background, near=0.01)
        (render.rgb.square().sum() + render.alpha.sum() + render.depth.sum()).backward()
        gradients = [p.grad for p in gaussians.tensors().values()] + [render.info["means2d"].grad]
        results.append([x.detach().cpu() for x in (render.rgb, render.alpha, render.depth, *gradients)])
    for ours, theirs in zip(*results, strict=True):
        assert (ours - theirs).norm() < 2e-3 * theirs.norm()
