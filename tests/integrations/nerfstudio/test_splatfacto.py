"""Splatfacto's arithmetic inside the real nerfstudio; a rasteriser of our own stands in for the one on CUDA."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: see scripts/nerfstudio_env.sh")


from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hooks.regularizer import outside_loss
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.integrations.nerfstudio import splats
from visdom_plugin.integrations.nerfstudio.dataparser import METADATA

from .host import HULL, build


def blobs(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **_):
    """Alpha and colour of isotropic blobs, drawn one over the other without order; (1, H, W, C)."""
    local = means @ viewmats[0, :3, :3].mT + viewmats[0, :3, 3]
    pixel = local @ Ks[0].mT
    uv = pixel[:, :2] / pixel[:, 2:].clamp_min(0.01)
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = (u[..., None] - uv[:, 0]) ** 2 + (v[..., None] - uv[:, 1]) ** 2
    clear = 1 - opacities * torch.exp(-0.5 * away)
    alpha = 1 - clear.prod(-1, keepdim=True)
    return alpha.expand(height, width, 3)[None] * 0.5, alpha[None], {"means2d": uv[None], "width": width}


@pytest.fixture
def splat_model(train, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *_, **__: self)
    monkeypatch.setattr("nerfstudio.models.splatfacto.rasterization", blobs)
    config = splats.SplatfactoVdConfig(
        hull=HULL,
        initial_points=60,
        sh_degree=0,
        vd=RegularizerConfig(enabled=True, prune_every=3, weight=0.5),
    )
    with torch.compiler.set_stance("force_eager"):
        model = build(config, train).train()
        model.optimizers = {
            name: torch.optim.Adam([{"params": [p], "name": name}], lr=1e-3)
            for name, p in model.gauss_params.items()
        }
        yield model


def splat_batch(train):
    views = train.metadata[METADATA].views
    rgba = torch.cat([views.images[0], 255 * views.masks[0].byte()[..., None]], -1)
    return {"image": rgba}


def test_splats_start_inside_the_hull_with_its_colours(splat_model):
    world = splat_model.frame.points_to_world(splat_model.means.detach())
    assert splat_model.num_points == 60 and splat_model.hook.hull.contains(world, margin_voxels=1).all()
    xyz, rgb = splat_model.hook.initial_points(60, torch.Generator().manual_seed(0))
    assert torch.allclose(world, xyz.double(), atol=1e-5)
    assert torch.allclose(splat_model.colors.detach(), rgb, atol=1e-4)


def test_splats_pay_for_opacity_beside_the_hull(splat_model, train):
    """L_i is taken at a full view between the training cameras, at the weight of the settings."""
    camera = train.cameras[:1]
    outputs = splat_model(camera)
    left_behind = splat_model.info
    losses = splat_model.get_loss_dict(outputs, splat_batch(train))
    assert {"main_loss", "mask_loss", "visdom_outside"} <= losses.keys()
    assert splat_model.info is left_behind and splat_model._get_downscale_factor() == 4
    view = splat_model.hook._draw(torch.Generator().manual_seed(splat_model.step))[0]
    alpha = splat_model.render_opacity(view)
    assert alpha.shape == (int(view.height), int(view.width))
    silhouette = depth_and_silhouette(splat_model.hook.hull, view)[1]
    expected = 0.5 * outside_loss(alpha, silhouette)
    assert expected > 0 and torch.allclose(losses["visdom_outside"], expected)
    losses["visdom_outside"].backward()
    assert splat_model.opacities.grad.abs().sum() > 0


def test_splats_outside_go_with_their_optimisers_state(splat_model, train):
    outputs = splat_model(train.cameras[:1])
    sum(splat_model.get_loss_dict(outputs, splat_batch(train)).values()).backward()
    for optimiser in splat_model.optimizers.values():
        optimiser.step()
    moments = splat_model.optimizers["opacities"].state[splat_model.opacities]["exp_avg"].clone()
    with torch.no_grad():
        splat_model.means[7:20] += 5.0
    kept = torch.ones(60, dtype=torch.bool)
    kept[7:20] = False
    before = splat_model.opacities.detach().clone()
    splat_model.prune_outside(1)
    assert splat_model.num_points == 60
    splat_model.prune_outside(3)
    assert splat_model.num_points == 47 and torch.equal(splat_model.opacities, before[kept])
    assert all(len(p) == 47 for p in splat_model.gauss_params.values())
    state = splat_model.optimizers["opacities"].state[splat_model.gauss_params["opacities"]]
    assert torch.equal(state["exp_avg"], moments[kept])
